"""Bias, lost frames and latency on exact poses."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from tests.helpers.clocks import set_time


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


@pytest.mark.parametrize("period_s", [0.04, 0.1, 0.15])
@pytest.mark.parametrize("latency_s", [0.0, 0.1, 0.4])
def test_latency_is_a_time_however_often_one_looks(period_s: float, latency_s: float) -> None:
    task, speed = get_task("GraspCube"), 0.5
    sim = Simulation(task, 1)
    sim.reset([{"robot": [-0.45, 0.05, 0.1], "object": [0.0, -0.05, 0.3]}])
    perceiver = make_perceiver(f"exact,latency_s={latency_s}", task, 1)
    perceiver.begin(np.array([0]), [3])
    T, T_world_camera = sim.pose("cube")[0], sim.pose("head_camera")[0]
    for index in range(20):
        set_time(sim, period_s * index)
        sim.set_pose("cube", poses.pose([0.0, speed * period_s * index, 0.0]) @ T)
        told = perceiver.observe(sim, np.array([0]))
    sim.close()
    late_s = (T[1, 3] + speed * period_s * 19 - (T_world_camera @ told.T_camera_object[0, 0])[1, 3]) / speed
    assert latency_s - 1e-6 <= late_s < latency_s + period_s - 1e-6  # the newest that is old enough
    assert told.age_s[0, 0] == pytest.approx(late_s, abs=1e-6)


def test_what_frames_lose_grows_old_by_the_worlds_clock() -> None:
    task, ages = get_task("GraspCube"), []
    sim = Simulation(task, 1)
    perceiver = make_perceiver("exact,dropout=1", task, 1)
    perceiver.begin(np.array([0]), [3])
    for index in range(6):
        set_time(sim, 0.04 * index)
        ages.append(perceiver.observe(sim, np.array([0])).age_s[0, 0])
    sim.close()
    np.testing.assert_allclose(ages, 0.04 * np.arange(6), atol=1e-9)
