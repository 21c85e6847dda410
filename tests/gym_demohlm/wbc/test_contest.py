"""Controllers are compared under the same commands; one differs from itself in nothing; wrong contests are refused."""

import importlib.util
import math

import numpy as np
import pytest

from gym_demohlm.control import command, controllers
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Gait, Settings
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.wbc.evaluation import contest, peer
from gym_demohlm.wbc.evaluation.trial import Disturbance
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

_SMALL = {"num_worlds": 2, "seconds": 7.0, "num_threads": 1, "num_seeds": 1}  # in 4 s nobody walks for long
_INSTALLED = all(importlib.util.find_spec(module) for module in ("holosoma_inference", "onnxruntime"))


def test_a_controller_beside_itself_differs_in_nothing() -> None:
    (line,) = contest.contest(["default", controllers.installed()[0].hash], "velocity", **_SMALL)
    assert line["controller"] == line["beside"] == controllers.installed()[0].name
    assert [row["name"] for row in line["rows"]] == list(contest.PROTOCOLS["velocity"].rows)
    for row in line["rows"]:
        assert row["new"] == row["old"] or math.isnan(row["new"])
        assert math.isnan(row["low"]) or row["low"] == row["high"] == 0.0
    assert sum(math.isfinite(row["new"]) for row in line["rows"]) > len(line["rows"]) / 2


def test_an_ablation_changes_one_setting_and_what_robots_do() -> None:
    (line,) = contest.ablate("default", ["sway"], **_SMALL)
    assert line["controller"] == "without sway"
    velocity = line["rows"][0]
    assert velocity["name"] == "linear_velocity_error"
    assert math.isfinite(velocity["new"]) and velocity["new"] != velocity["old"]


def test_parts_that_a_controller_does_not_have_are_skipped() -> None:
    """The first controller has no recovery and sways as at first."""
    assert not list(contest.ablate("8ac4c8cd0008", ["recovery", "sway", "velocity-map"], **_SMALL))


@pytest.mark.parametrize("part", contest.ABLATIONS)
def test_each_ablation_sets_its_part_back_and_nothing_else(part: str) -> None:
    own = controllers.load().settings
    ablated = contest.ABLATIONS[part](own)
    assert ablated != own, "the default controller has every part"
    changed = [name for name, value in vars(ablated).items() if value != getattr(own, name)]
    assert len(changed) == 1
    if changed == ["gait"]:
        first = Gait()
        (name,) = [name for name, value in vars(ablated.gait).items() if value != getattr(own.gait, name)]
        assert getattr(ablated.gait, name) == getattr(first, name)
    assert contest.ABLATIONS[part](Settings()) in (Settings(), ablated, contest.ABLATIONS["trim"](Settings()))


@pytest.mark.parametrize(
    ("names", "protocol", "error", "match"),
    [
        (["default"], "whole", SceneError, "two or more"),
        (["default", "holosoma"], "whole", SceneError, "--protocol arms or velocity"),
        (["default", "holosoma-p"], "velocity", UnknownNameError, "controller"),
        (["default", "default"], "velocities", UnknownNameError, "velocity"),
        (["default", "nowhere.npz"], "whole", SceneError, "check the path"),
    ],
)
def test_a_wrong_contest_is_refused(names: list[str], protocol: str, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        next(contest.contest(names, protocol, **_SMALL))
    with pytest.raises(UnknownNameError, match="sway"):
        next(contest.ablate("default", ["swai"], **_SMALL))


def test_upright_robots_move_their_arms_and_still_ones_do_not() -> None:
    upright, still = CommandRange().upright(), CommandRange().velocity_only()
    assert upright.arm_speed == CommandRange().arm_speed
    assert still.arm_speed == (0.0, 0.0)
    for ranges in (upright, still):
        assert ranges.height == ranges.walking_height == (g1.PELVIS_HEIGHT, g1.PELVIS_HEIGHT)
        assert ranges.pitch == ranges.roll == ranges.yaw == ranges.walking_pitch == (0.0, 0.0)


@pytest.mark.skipif(not _INSTALLED, reason="needs holosoma-inference")
def test_the_arms_of_a_public_controller_go_where_they_are_sent_and_bear_a_load() -> None:
    simulation = peer.PeerSimulation(
        1, peer.load_policy("holosoma"), Disturbance(hand_loads=(1.0, 1.0)), moving_arms=True
    )
    commands = command.rest()[None]
    commands[:, command.ARMS] = g1.HOME[-14:]
    for _ in range(30):
        simulation.step(commands)
    assert not simulation.fallen().any()
    arms = simulation.joint_positions[0, -14:]
    np.testing.assert_allclose(arms, g1.HOME[-14:], atol=0.1)


@pytest.mark.skipif(not _INSTALLED, reason="needs holosoma-inference")
def test_a_public_controller_acts_the_same_wherever_moving_arms_are() -> None:
    controller = peer.PeerController(2, peer.load_policy("holosoma"), moving_arms=True)
    q, dq = np.tile(g1.HOME, (2, 1)), np.zeros((2, 29))
    q[1, -14:] += 0.5
    dq[1, -14:] = 1.0
    sensed = Proprioception(quat_wxyz=np.tile([1.0, 0, 0, 0], (2, 1)), gyro=np.zeros((2, 3)), q=q, dq=dq)
    commands = np.tile(command.rest(), (2, 1))
    commands[1, command.ARMS] += 0.1
    targets = controller.step(sensed, commands)
    np.testing.assert_array_equal(targets[0, :-14], targets[1, :-14])
    np.testing.assert_array_equal(targets[:, -14:], commands[:, command.ARMS])


def test_robots_have_the_physics_that_is_asked_for() -> None:
    first, second = (
        next(contest.contest(["default", "default"], "velocity", **_SMALL, physics=name))
        for name in ("first", "second")
    )
    assert (first["physics"], second["physics"]) == ("first", "second")
    old = [line["rows"][0]["old"] for line in (first, second)]
    assert all(map(math.isfinite, old)) and old[0] != old[1]
    with pytest.raises(UnknownNameError, match="second"):
        next(contest.contest(["default", "default"], "velocity", **_SMALL, physics="secnd"))
