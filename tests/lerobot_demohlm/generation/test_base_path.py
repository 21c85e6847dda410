"""A base that answers commands with another gait still walks as far, and to the same place, as the demonstrated one."""

import dataclasses

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration, pose_numbers
from lerobot_demohlm.generation.base_path import BasePath
from lerobot_demohlm.generation.stages import PlaybackSettings

START, STOP = 20, 50
SPEED = 0.2  # m/s, of the demonstrated base


@pytest.fixture(scope="module")
def walking() -> Demonstration:
    """A demonstration that walks 0.6 m ahead between two ticks and stands before and after."""
    demonstration = demonstrations.load(task=get_task("LiftBox"))
    action = demonstration.action.copy()
    action[:, command.VELOCITY] = 0.0
    action[START:STOP, 0] = SPEED
    walked = 0.1 * SPEED * np.clip(np.arange(len(action)) - START, 0, STOP - START)
    return dataclasses.replace(
        demonstration, action=action, pelvis_pose=pose_numbers(poses.planar(walked, np.zeros(len(action)), 0.0))
    )


def walk(demonstration: Demonstration, base: np.ndarray, share: float) -> tuple[np.ndarray, int]:
    """Let a base (3,) answer with a share of the forward speed; returns where it ends, and how long it walked."""
    path, settings = BasePath(demonstration, PlaybackSettings()), PlaybackSettings()
    ticks = 0

    def step(base: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        moved = 0.1 * velocity * np.array([share, 1.0, 1.0])
        return poses.to_planar(poses.planar(*base) @ poses.planar(*moved))

    for tick in range(len(demonstration)):
        velocity = path.velocity(tick, poses.planar(*base))
        assert (np.abs(velocity) > 0).any() == (START <= tick < STOP)
        base = step(base, velocity)
        ticks += int(START <= tick < STOP)
        if path.ends(tick):
            assert tick == STOP - 1
            for _ in range(settings.arrive_ticks):
                velocity = path.remaining_velocity(tick, poses.planar(*base))
                if velocity is None:
                    break
                base, ticks = step(base, velocity), ticks + 1
    return base, ticks


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize("share", [0.4, 0.7, 1.0, 1.3])
def test_it_walks_as_far_whatever_the_gait(walking: Demonstration, share: float, yaw: float) -> None:
    start = np.array([0.3, -0.2, yaw])
    base, _ = walk(walking, start, share)
    went = poses.to_planar(poses.invert(poses.planar(*start)) @ poses.planar(*base))
    np.testing.assert_allclose(went, [0.1 * SPEED * (STOP - START), 0.0, 0.0], atol=0.08)


def test_a_base_that_answers_as_demonstrated_repeats_the_velocities(walking: Demonstration) -> None:
    base, ticks = walk(walking, np.zeros(3), 1.0)
    assert ticks == STOP - START
    np.testing.assert_allclose(base, [0.6, 0.0, 0.0], atol=1e-6)
