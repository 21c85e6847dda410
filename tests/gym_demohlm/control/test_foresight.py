"""Foresight on made-up motions: rest stays rest, a gait is told a step ahead, its mean comes without the sway."""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import gait_clock
from gym_demohlm.control.foresight import Foresight
from gym_demohlm.robot import g1

DT = 0.1


def walk(time: float, sway: float) -> np.ndarray:
    """Pose of a pelvis that goes ahead on a slow curve and rolls with the gait."""
    phase = 2 * np.pi * time / gait_clock.GAIT.period_s
    yaw = 3.0 + 0.1 * time  # passes pi
    T = poses.planar(0.25 * time, 0.02 * time**2 + 0.3 * sway * np.sin(phase), yaw)
    T[:3, :3] = poses.rotation_from_rpy([sway * np.sin(phase + 1.0), 0.0, yaw])
    T[2, 3] = 0.72
    return T


def test_rest_stays_rest() -> None:
    T = poses.planar(0.3, -1.0, 2.0)
    T[2, 3] = 0.7
    foresight = Foresight()
    for _ in range(5):
        outlook = foresight.see(T, g1.HOME)
    np.testing.assert_allclose(outlook.T_world_pelvis, T, atol=1e-12)
    np.testing.assert_allclose(outlook.joint_positions, g1.HOME, atol=1e-12)
    np.testing.assert_allclose(outlook.T_world_heading, poses.planar(0.3, -1.0, 2.0), atol=1e-12)


def test_a_gait_is_told_a_step_ahead_and_its_mean_without_the_sway() -> None:
    foresight = Foresight()
    ahead, now, mean = [], [], []
    for step in range(60):
        outlook = foresight.see(walk(DT * step, 0.06), g1.HOME)
        coming = walk(DT * (step + 1), 0.06)
        if step >= 25:
            ahead.append(np.linalg.norm(poses.rpy(poses.invert(coming)[:3, :3] @ outlook.T_world_pelvis[:3, :3])))
            now.append(np.linalg.norm(poses.rpy(poses.invert(coming)[:3, :3] @ walk(DT * step, 0.06)[:3, :3])))
            mean.append(np.linalg.norm(outlook.T_world_heading[:2, 3] - walk(DT * (step + 1), 0.0)[:2, 3]))
    assert max(ahead) < 0.01 < 0.04 < max(now)
    assert max(mean) < 0.003


def test_forgetting_starts_anew() -> None:
    foresight, fresh = Foresight(), Foresight()
    for step in range(7):
        foresight.see(walk(DT * step, 0.06), g1.HOME)
    foresight.reset()
    first, second = (one.see(walk(0.3, 0.02), g1.HOME) for one in (foresight, fresh))
    assert np.array_equal(first.T_world_pelvis, second.T_world_pelvis)
    assert np.array_equal(first.T_world_heading, second.T_world_heading)
