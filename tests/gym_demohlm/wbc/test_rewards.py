"""The table of rewards: every term counts by its weight, can be set by name, and is the same in a mirror."""

from dataclasses import fields, replace

import numpy as np
import pytest

from gym_demohlm.control import features, gait_clock
from gym_demohlm.control.settings import Gait
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.wbc.training import rewards
from gym_demohlm.wbc.training.rewards import REWARDS, Measured, Outcome

_WORLDS = 24  # enough for every term to count in one of them
_SHAPES = {"velocity": 2, "gyro": 3, "joint_velocity": 15, "torque": 15, "touch": 2, "sole_height": 2, "sole_speed": 2}
_SHAPES |= {"landing_speed": 2, "sole_yaw": 2}
_SWAPPED = ("touch", "sole_height", "sole_speed", "landing_speed", "sole_yaw")
_TURNED = ("yaw_rate", "torso_roll", "waist_yaw", "stance_length", "sole_yaw")


def _outcome(seed: int = 0) -> Outcome:
    rng = np.random.default_rng(seed)
    sizes = {
        entry.name: (_WORLDS, _SHAPES[entry.name]) if entry.name in _SHAPES else (_WORLDS,)
        for entry in fields(Measured)
    }
    measured = {name: rng.normal(0, 0.1, size) for name, size in sizes.items()}
    measured["height"] += 0.7
    measured["stance_width"] = rng.uniform(0.0, 0.6, _WORLDS)
    measured["touch"] = rng.uniform(0, 900, (_WORLDS, 2)) * (rng.random((_WORLDS, 2)) < 0.6)
    for name in ("sole_speed", "landing_speed", "sole_tilt"):
        measured[name] = measured[name] ** 2
    command = rng.normal(0, 0.2, (_WORLDS, 7)) * (rng.random((_WORLDS, 1)) < 0.5) + [0, 0, 0, 0.7, 0, 0, 0]
    actions = rng.normal(0, 0.5, (3, _WORLDS, features.ACTION_SIZE))
    return Outcome(
        m=Measured(**measured),
        command=command,
        clock=gait_clock.Clock(rng.random(_WORLDS), np.zeros(_WORLDS), rng.random(_WORLDS) < 0.5, np.zeros(_WORLDS)),
        gait=Gait(),
        action=actions[0],
        last_action=actions[1],
        action_before=actions[2],
        mean_error=rng.normal(0, 0.1, (_WORLDS, 3)),
    )


def _mirrored(o: Outcome) -> Outcome:
    """Return the outcome as a mirror shows it: left and right swapped, half a period later."""
    source, sign = features.ACTION_MIRROR
    changed = {name: getattr(o.m, name)[:, ::-1] for name in _SWAPPED}
    changed |= {name: -changed.get(name, getattr(o.m, name)) for name in _TURNED}
    changed |= {name: getattr(o.m, name)[:, source] * sign for name in ("joint_velocity", "torque")}
    changed |= {"velocity": o.m.velocity * [1, -1], "gyro": o.m.gyro * [-1, 1, -1]}
    command_source, command_sign = features.COMMAND_MIRROR
    return replace(
        o,
        m=replace(o.m, **changed),
        command=o.command[:, command_source] * command_sign,
        clock=o.clock._replace(phase=(o.clock.phase + 0.5) % 1.0),
        action=o.action[:, source] * sign,
        last_action=o.last_action[:, source] * sign,
        action_before=o.action_before[:, source] * sign,
        mean_error=o.mean_error * [1, -1, -1],
    )


@pytest.mark.parametrize("name", REWARDS)
def test_a_term_counts_by_its_weight_and_is_the_same_in_a_mirror(name: str) -> None:
    outcome = _outcome()
    term = replace(REWARDS[name], weight=1.0)
    once, means = rewards.total(outcome, {name: term})
    twice, _ = rewards.total(outcome, {name: replace(term, weight=2.0)})
    assert once.shape == (_WORLDS,)
    assert np.isfinite(once).all() and once.any(), "a term that is 0 shows nothing"
    np.testing.assert_allclose(twice, 2 * once)
    assert means == {name: pytest.approx(once.mean())}
    np.testing.assert_allclose(rewards.total(_mirrored(outcome), {name: term})[0], once, atol=1e-12)


def test_the_total_is_the_sum_of_its_terms() -> None:
    outcome = _outcome(1)
    parts = [rewards.total(outcome, {name: term})[0] for name, term in REWARDS.items() if term.weight]
    found, means = rewards.total(outcome, REWARDS)
    np.testing.assert_allclose(found, np.sum(parts, axis=0))
    assert sum(means.values()) == pytest.approx(found.mean())


def test_a_weight_of_zero_leaves_a_term_out() -> None:
    table = rewards.with_weights({"power": 0.0, "velocity": 3.0})
    assert table["velocity"].weight == 3.0
    assert table["velocity"].scale == REWARDS["velocity"].scale
    assert "power" not in rewards.total(_outcome(), table)[1]
    assert REWARDS["power"].weight < 0.0


def test_weights_are_given_by_name() -> None:
    assert rewards.parse("power=-0.004") == ("power", -0.004)
    with pytest.raises(UnknownNameError, match="did you mean 'power'"):
        rewards.parse("powr=1")
    for wrong in ("power", "power=nan", "power=inf"):
        with pytest.raises(SceneError, match="NAME=WEIGHT"):
            rewards.parse(wrong)
    with pytest.raises(UnknownNameError):
        rewards.with_weights({"slipp": 1.0})


def test_a_foot_that_lands_is_charged_its_speed_in_the_air_once() -> None:
    address = {f"{side}_sole_{what}": slice(0) for side in ("left", "right") for what in ("vel", "touch")}
    address = dict(zip(address, (slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 8)), strict=True))
    in_the_air = np.array([[1.0, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 300.0]])
    air = rewards.Air.read(in_the_air, address)
    assert air.lifted.tolist() == [[True, False]]
    assert air.speed[0, 0] == 1.25
