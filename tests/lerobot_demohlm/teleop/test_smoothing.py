"""Smoothing: a tremor goes, motion stays, and what jumps is not dragged along."""

import math

import numpy as np

from gym_demohlm import poses
from lerobot_demohlm.teleop.smoothing import PoseSmoother, SmoothingSettings

HZ = 72
TREMOR_M = 0.005  # root mean square


def trembled(T: np.ndarray, time_s: float) -> np.ndarray:
    shaken = T.copy()
    sizes = TREMOR_M * math.sqrt(2 / 3) * np.ones(3)
    shaken[:3, 3] += sizes * np.sin(2 * math.pi * np.array([5.0, 8.0, 11.0]) * time_s)
    return shaken


def test_a_hand_that_is_still_loses_its_tremor() -> None:
    smoother = PoseSmoother(SmoothingSettings())
    times = np.arange(8 * HZ) / HZ
    seen = np.stack([smoother(trembled(np.eye(4), t), t)[:3, 3] for t in times])[2 * HZ :]
    assert np.sqrt((seen**2).sum(axis=1).mean()) < 0.3 * TREMOR_M


def test_a_hand_that_moves_is_followed() -> None:
    smoother = PoseSmoother(SmoothingSettings())
    behind = []
    for t in np.arange(3 * HZ) / HZ:
        u = np.clip((t - 1.0) / 1.2, 0.0, 1.0)
        T = poses.from_rotation(poses.rotation_from_rpy([0.0, 0.0, u]), [0.3 * u**3 * (10 - 15 * u + 6 * u**2), 0, 0])
        smooth = smoother(trembled(T, t), t)
        behind.append(np.linalg.norm(smooth[:3, 3] - T[:3, 3]))
    assert max(behind) < 0.025
    assert behind[-1] < 0.005
    assert np.linalg.norm(poses.rotation_vector(smooth[:3, :3] @ T[:3, :3].T)) < 0.02


def test_the_first_pose_and_one_that_jumps_are_passed_on_as_they_are() -> None:
    smoother = PoseSmoother(SmoothingSettings())
    here, there = poses.pose([0.1, 0.2, 0.3]), poses.pose([0.5, 0.2, 0.3])
    np.testing.assert_array_equal(smoother(here, 5.0), here)
    np.testing.assert_array_equal(smoother(there, 5.01), there)
    near = poses.pose([0.52, 0.2, 0.3])
    assert not np.array_equal(smoother(near, 5.02), near)
    np.testing.assert_array_equal(smoother(here, 9.0), here)  # nothing was heard for a while
    smoother.reset()
    np.testing.assert_array_equal(smoother(near, 9.01), near)


def test_none_changes_nothing() -> None:
    smoother = PoseSmoother(None)
    T = poses.pose([0.1, 0.2, 0.3])
    assert all(np.array_equal(smoother(trembled(T, t), t), trembled(T, t)) for t in (0.0, 0.1, 0.2))


def test_times_that_hardly_differ_make_no_nan() -> None:
    smoother = PoseSmoother(SmoothingSettings())
    for time_s in (1e-310, 2e-310, 3e-310):
        assert np.isfinite(smoother(poses.pose([0.1 + 1e300 * time_s, 0.0, 0.0]), time_s)).all()
