"""The velocity that a policy must be told: what a fit finds, what it leaves alone, and how far it goes."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_demohlm.control import command, features, velocity_map
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Settings
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, WEIGHTS_FOLDER, Weights, WholeBodyController
from gym_demohlm.errors import SceneError
from gym_demohlm.wbc.evaluation import calibration
from gym_demohlm.wbc.evaluation.calibration import calibrate, walk

_SIGNS = np.array(features.COMMAND_MIRROR[1])


def _commands(rng: np.random.Generator, count: int) -> np.ndarray:
    found = np.tile(command.rest()[:7], (count, 1))
    found[:, :3] = rng.uniform([-0.5, -0.4, -1.0], [0.8, 0.4, 1.0], (count, 3))
    found[:, 3], found[:, 5] = rng.uniform(0.6, 0.76, count), rng.uniform(-0.3, 0.3, count)
    return found


def _robot(told: np.ndarray) -> np.ndarray:
    """Return how a robot that is no robot walks: too slowly, slower in a squat, and aside where it turns."""
    forward = told[:, 0] * (0.85 + 0.5 * (told[:, 3] - 0.68)) - 0.03 * told[:, 2] ** 2
    aside = 0.7 * told[:, 1] + 0.05 * told[:, 2] * told[:, 0]
    return np.stack([forward, aside], axis=1)


def test_a_fit_makes_up_for_most_of_what_a_robot_falls_short_of() -> None:
    rng = np.random.default_rng(0)
    told = _commands(rng, 400)
    told[:, :3] *= 1.3
    chosen = velocity_map.fit(told, _robot(told))
    asked = _commands(rng, 200)
    further = asked.copy()
    further[:, :2] += velocity_map.further(chosen, asked)
    missed, plain = (np.abs(_robot(each) - asked[:, :2]).mean(axis=0) for each in (further, asked))
    assert (missed < 0.15 * plain).all()


@given(seed=st.integers(0, 2**32 - 1))
def test_left_and_right_are_treated_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    told, other = _commands(rng, 60), _commands(rng, 8)
    chosen = velocity_map.fit(told, _robot(told) + 0.05 * rng.normal(size=(60, 2)))
    mirrored = velocity_map.further(chosen, other * _SIGNS)
    np.testing.assert_allclose(mirrored, velocity_map.further(chosen, other) * _SIGNS[:2], atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_it_adds_nothing_where_no_velocity_is_commanded_and_never_too_much(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chosen = rng.normal(size=(2, velocity_map.NUM_TERMS))
    commands = 5.0 * _commands(rng, 8)
    assert (np.abs(velocity_map.further(chosen, commands)) <= velocity_map.LARGEST).all()
    commands[:, :3] = 0.0
    assert (velocity_map.further(chosen, commands) == 0.0).all()


def test_without_coefficients_nothing_is_added() -> None:
    commands = _commands(np.random.default_rng(0), 3)
    assert velocity_map.further(velocity_map.coefficients(()), commands).shape == (3, 0)


@pytest.mark.parametrize(
    "rows", [[[0.0]], [[0.0] * velocity_map.NUM_TERMS], [[float("nan")] * velocity_map.NUM_TERMS] * 2]
)
def test_a_map_that_is_none_is_refused(rows: list[list[float]]) -> None:
    with pytest.raises(SceneError, match="velocity map"):
        Settings.read({"velocity_map": rows})


def test_settings_keep_it_as_json() -> None:
    rows = tuple(tuple(row) for row in np.random.default_rng(0).normal(size=(2, velocity_map.NUM_TERMS)).tolist())
    how = Settings(velocity_map=rows)
    assert Settings.read(json.loads(json.dumps(how.metadata()))) == how


def test_a_fit_learns_from_the_commands_that_robots_got(monkeypatch: pytest.MonkeyPatch) -> None:
    """Velocities beyond the range reach the controller, though a simulation would keep them within it."""
    got = []

    def step(self: WholeBodyController, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray) -> np.ndarray:
        got.append(commands)
        return plain(self, sensed, commands, worlds)

    plain = WholeBodyController.step
    monkeypatch.setattr(WholeBodyController, "step", step)
    monkeypatch.setattr(calibration, "_SETTLE_S", 0.1)
    monkeypatch.setattr(calibration, "_LOOK_S", 0.1)
    told = walk(DEFAULT_WEIGHTS, 16).told
    assert (told[:, :3] > command.UPPER[:3]).any(axis=0).all()
    assert all(np.array_equal(commands[:, :7], told) for commands in got)


@pytest.mark.slow
def test_calibrated_robots_walk_nearer_to_their_commands(tmp_path: Path) -> None:
    weights = WEIGHTS_FOLDER / "8ac4c8cd0008.npz"
    mapped = tmp_path / "mapped.npz"
    calibrate(weights, mapped)
    assert Weights(mapped).settings.gain[:2] == (1.0, 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["mapped.npz"]
    missed = {}
    for path in (weights, mapped):
        found = walk(path, 48, seed=1, beyond=1.0)
        missed[path] = np.linalg.norm(found.velocity - found.told[:, :2], axis=1).mean()
    assert missed[mapped] < 0.9 * missed[weights]
