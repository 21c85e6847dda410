"""Pauses of a demonstration: found where they are, and not where a hand, the base or a gripper moves."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from lerobot_demohlm import cli
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import ARRAYS, Demonstration
from lerobot_demohlm.demonstrations.pauses import LEAST_TICKS, pauses

LENGTH, START, STOP = 60, 20, 20 + LEAST_TICKS + 1


@pytest.fixture
def still() -> Demonstration:
    """Return a recording whose hands move at 0.1 m/s but for a stretch."""
    packaged = demonstrations.load(task=get_task("GraspCube"))
    moving = np.ones(LENGTH)
    moving[START:STOP] = 0.0
    hands = packaged.hand_poses[:1].repeat(LENGTH, axis=0)
    hands[..., 0] += (0.01 * np.cumsum(moving) - 0.01)[:, None]
    first = {name: getattr(packaged, name)[:1].repeat(LENGTH, axis=0) for name in ARRAYS}
    return replace(packaged, **{**first, "hand_poses": hands})


def test_a_stretch_without_motion_is_a_pause(still: Demonstration) -> None:
    assert pauses(still) == [(START - 1, STOP - 1)]  # from the last tick that has moved on
    assert pauses(still, least_ticks=LEAST_TICKS + 2) == []


@pytest.mark.parametrize("what", ["pelvis", "gripper"])
def test_a_base_that_moves_and_a_gripper_that_closes_are_no_pause(still: Demonstration, what: str) -> None:
    middle = (START + STOP) // 2
    if what == "pelvis":
        moved = still.pelvis_pose.copy()
        moved[middle:, 0] += 0.02
        changed = replace(still, pelvis_pose=moved)
    else:
        action = still.action.copy()
        action[middle:, command.GRIPPERS] = 1.0
        changed = replace(still, action=action)
    assert pauses(changed) == []


def test_segment_prints_the_pauses(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["segment", "--task", "PourWater"])
    printed = capsys.readouterr().out
    found = pauses(demonstrations.load(task=get_task("PourWater")))
    assert found and all(f"{start:>4}-{stop:<4}" in printed for start, stop in found)
