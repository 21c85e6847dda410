"""Where a robot is, counted from its feet, and what that does for poses that are a little old."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from lerobot_demohlm.hardware import robot_observation
from lerobot_demohlm.hardware.odometry import odometry_camera
from tests.helpers.robot import Told

LATE = 2  # steps of 0.1 s by which a look is old


@pytest.mark.parametrize("walks", [False, True], ids=["bends", "walks"])
def test_an_old_look_tells_where_objects_are_now(walks: bool) -> None:
    told, wanted = Told("LiftBox"), command.rest()
    gaze = [entry.name for entry in get_task("LiftBox").objects].index("box")
    if walks:
        wanted[command.VELOCITY] = [-0.3, 0.0, 0.2]
    else:
        wanted[command.HEIGHT], wanted[command.PITCH] = 0.55, 0.5
    looks, off, uncorrected = [], [], []
    for index in range(25):
        told.sim.step(wanted[None])
        state, pose = told.read("state"), told.read("pose")
        servos = told.read("servos")
        assert state is not None and pose is not None and servos is not None
        looks.append(pose.value)
        if index >= LATE:
            true = looks[-1]["T_camera_object"][gaze]
            old = looks[-1 - LATE]
            told_now = robot_observation.objects(old, state.value, servos.value)[gaze]
            off.append(np.linalg.norm((told_now - true)[:3, 3]))
            uncorrected.append(np.linalg.norm((old["T_camera_object"][gaze] - true)[:3, 3]))
    told.sim.close()
    assert max(uncorrected) > 0.05
    assert max(off) < 0.015


def test_the_head_camera_is_where_the_model_has_it() -> None:
    told = Told("LiftBox")
    rng = np.random.default_rng(0)
    for _ in range(8):
        told.sim.step((command.rest() + rng.normal(scale=0.3, size=command.SIZE))[None])
    state, servos = told.read("state"), told.read("servos")
    assert state is not None and servos is not None
    found = poses.invert(state.value["T_odometry_pelvis"]) @ odometry_camera(state.value, servos.value)
    expected = poses.invert(told.sim.pose("pelvis")[0]) @ told.sim.pose("head_camera")[0]
    told.sim.close()
    np.testing.assert_allclose(found, expected, atol=1e-4)
