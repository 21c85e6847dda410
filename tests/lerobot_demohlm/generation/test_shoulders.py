"""Hands on their way to things higher up keep clear of their shoulders, where a folded arm would get stuck."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.shoulders import before_shoulder
from lerobot_demohlm.generation.stages import Settings

CLEAR_M = 0.3
ROLL = command.NAMES.index("right_shoulder_roll.pos")
AHEAD = np.array([1.0, 0.0, 0.0])


def _path(points: np.ndarray) -> np.ndarray:
    return poses.pose(points, np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)))


@pytest.mark.parametrize("seed", range(5))
def test_a_way_keeps_clear_by_moving_straight_ahead_and_stays_where_it_is_clear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shoulder = rng.uniform(-1.0, 1.0, 3)
    offsets = rng.uniform([0.0, -0.4, -0.4], [0.6, 0.4, 0.4], (200, 3))
    path = _path(shoulder + offsets)
    found = before_shoulder(path, shoulder, AHEAD, CLEAR_M)
    apart = np.linalg.norm(found[:, :3, 3] - shoulder, axis=1)
    assert apart.min() >= CLEAR_M - 1e-9
    clear = np.linalg.norm(offsets, axis=1) >= CLEAR_M
    assert clear.any() and not clear.all()
    np.testing.assert_array_equal(found[clear], path[clear])
    moved = found[:, :3, 3] - path[:, :3, 3]
    np.testing.assert_allclose(moved[:, 1:], 0.0, atol=1e-12)
    assert (moved[~clear, 0] > 0.0).all()


def test_a_palm_behind_its_shoulder_comes_in_front_of_it_unless_it_hangs_beside() -> None:
    behind, hanging = [-0.4, 0.0, 0.1], [-0.1, 0.1, -0.4]
    found = before_shoulder(_path(np.array([behind, hanging])), np.zeros(3), AHEAD, CLEAR_M)
    np.testing.assert_allclose(found[0, :3, 3], [np.sqrt(CLEAR_M**2 - 0.1**2), 0.0, 0.1])
    np.testing.assert_allclose(found[1, :3, 3], hanging)


def test_the_way_moves_with_robot_and_thing_as_one() -> None:
    rng = np.random.default_rng(3)
    motion, shoulder = poses.planar(0.7, -1.1, 2.0), np.array([0.1, -0.2, 1.0])
    path = _path(shoulder + rng.uniform(-0.4, 0.4, (50, 3)))
    together = before_shoulder(
        motion @ path, poses.transform(motion, shoulder[None])[0], motion[:3, :3] @ AHEAD, CLEAR_M
    )
    np.testing.assert_allclose(together, motion @ before_shoulder(path, shoulder, AHEAD, CLEAR_M), atol=1e-12)


def test_a_way_changes_by_no_jump() -> None:
    """A step of the way below, past and above the shoulder stays a step."""
    heights = np.linspace(-0.5, 0.5, 1001)
    path = _path(np.stack([np.full(1001, 0.1), np.full(1001, 0.05), heights], axis=1))
    found = before_shoulder(path, np.zeros(3), AHEAD, CLEAR_M)
    assert np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1).max() < 0.04
    assert found[[0, -1], 0, 3] == pytest.approx(0.1)


def test_a_board_17_cm_higher_is_wiped_with_the_elbow_below_the_shoulder() -> None:
    """In this start, seed 970001 attempt 8, the arm got stuck, and the robot ran into the board."""
    task = get_task("EraseBoard")
    rolls: list[float] = []
    attempts = Attempts(
        task,
        demonstrations.load(None, task),
        "R4",
        970001,
        settings=Settings(variation=PLAIN),
        on_step=lambda sim: rolls.append(float(sim.command[0, ROLL])),
    )
    (episode,) = attempts.run([8])
    assert episode.outcome == "success"
    assert min(rolls) > -1.7  # rad, right_shoulder_roll; stuck arms went to its end, -2.25
