"""Bias, lost frames and latency on exact poses."""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation


def _told(text: str, steps: int = 8, moving: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what is told (steps, 4, 4), the truth (steps, 4, 4), both in the camera's frame, and ages (steps,)."""
    task = get_task("GraspCube")
    sim = Simulation(task, 1)
    sim.reset([{"robot": [-0.45, 0.05, 0.1], "object": [0.0, -0.05, 0.3]}])
    perceiver, exact = make_perceiver(text, task, 1), make_perceiver("exact", task, 1)
    perceiver.begin(np.array([0]), [3])
    told, truth, ages = [], [], []
    T = sim.pose("cube")[0]
    for step in range(steps):
        sim.step(sim.command)
        if moving:
            sim.set_pose("cube", T @ poses.pose([0.0, 0.01 * step, 0.0]))
        estimate = perceiver.observe(sim, np.array([0]))
        told.append(estimate.T_camera_object[0, 0])
        ages.append(estimate.age_s[0, 0])
        truth.append(exact.observe(sim, np.array([0])).T_camera_object[0, 0])
    sim.close()
    return np.array(told), np.array(truth), np.array(ages)


def test_a_bias_has_its_length_and_stays_for_an_episode() -> None:
    told, truth, _ = _told("exact,bias_mm=20")
    off = told[:, :3, 3] - truth[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.020, rtol=1e-9)
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-12)
    turn = poses.rotation_vector(told[0, :3, :3] @ truth[0, :3, :3].T)
    np.testing.assert_allclose(np.linalg.norm(turn), np.radians(4.0), rtol=1e-6)


def test_what_rests_is_told_where_it_is_however_late_and_what_moves_where_it_was() -> None:
    told, truth, ages = _told("exact,latency_s=0.3")
    np.testing.assert_allclose(told[3:], truth[3:], atol=2e-3)  # a cube on a table settles by less
    np.testing.assert_allclose(ages[3:], 0.3)
    told, truth, _ = _told("exact,latency_s=0.3", moving=True)
    off = np.linalg.norm(told[4:, :3, 3] - truth[4:, :3, 3], axis=1)
    np.testing.assert_allclose(off, 0.03, atol=3e-3)


def test_lost_frames_are_as_many_as_asked_for_and_their_age_is_told() -> None:
    _, _, ages = _told("exact,dropout=0.5", steps=60)
    lost = (ages > 0).mean()
    assert 0.3 < lost < 0.7
    held = np.flatnonzero(ages > 0)
    np.testing.assert_allclose(ages[held], ages[held - 1] + 0.1)
    _, _, ages = _told("exact,dropout=1", steps=5)
    np.testing.assert_allclose(ages, [0.0, 0.1, 0.2, 0.3, 0.4])  # the first frame is always told
