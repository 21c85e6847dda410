"""A neck looks around for things that may be out of view, until it has seen them; others keep their gaze."""

import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control.gaze import GazeController
from gym_demohlm.perception.camera import head_intrinsics
from gym_demohlm.perception.looking import GLANCES, LONGEST_S, REST_S, LookAround
from gym_demohlm.perception.sight import Sight
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT
from tests.helpers.hold import HoldController

TARGET = np.array([1.0, 0.3, -0.4])  # m, on the torso
UNSEEN, SEEN = np.array([[0.0, np.inf]]), np.array([[0.0, 3.0]])


class Neck:
    """A head on a torso that rests, as far as ``LookAround`` asks; its neck obeys at once, within limits."""

    def __init__(self, stiff: bool = False) -> None:
        self.angles, self.stiff, self._gaze = np.zeros((1, 2)), stiff, GazeController()

    def pose(self, name: str) -> np.ndarray:
        assert name in ("torso", "head_camera")
        yaw, pitch = self.angles[0] if name == "head_camera" else (0.0, 0.0)
        T_pitch = np.eye(4)
        T_pitch[[0, 0, 2, 2], [0, 2, 0, 2]] = [math.cos(pitch), math.sin(pitch), -math.sin(pitch), math.cos(pitch)]
        return (poses.planar(0.0, 0.0, yaw) @ T_pitch)[None]

    def target(self) -> np.ndarray:
        """Where the target is in the camera's frame."""
        return (self.pose("head_camera")[0, :3, :3].T @ TARGET)[None]

    def look(self, around: LookAround, age_s: np.ndarray) -> np.ndarray:
        found = around.targets(cast(Simulation, self), np.array([0]), self.target(), age_s)
        if not self.stiff:
            self.angles = self._gaze.step(self.angles, found, STEP_DT)
        return found


def _around() -> LookAround:
    around = LookAround(get_task("CarryBox"), 1)
    around.begin(np.array([0]))
    return around


def test_it_shows_all_that_a_neck_can_turn_to_and_looks_at_its_target_in_between() -> None:
    neck, around = Neck(), _around()
    looked = []
    for _ in range(150):
        neck.look(around, UNSEEN)
        looked.append(neck.angles[0].copy())
    yaws = np.array(looked)[:, 0]
    half_picture = math.atan(head_intrinsics().width / 2 / head_intrinsics().focal)
    assert yaws.min() < GLANCES[:, 0].min() + 0.2 and yaws.max() > GLANCES[:, 0].max() - 0.2
    assert np.abs(np.diff(yaws)).max() < half_picture  # each direction is in several pictures
    at_target = np.abs(yaws - math.atan2(TARGET[1], TARGET[0])) < 0.05
    long = round(REST_S / STEP_DT) // 2
    rested = np.convolve(at_target, np.ones(long), "valid") == long
    assert (np.diff(rested.astype(int)) == 1).sum() >= 2  # it begins again


def test_it_stops_once_everything_was_seen() -> None:
    neck, around = Neck(), _around()
    for _ in range(5):
        assert not np.allclose(neck.look(around, UNSEEN), neck.target())
    here = neck.target()
    np.testing.assert_array_equal(around.targets(cast(Simulation, neck), np.array([0]), here, SEEN), here)


def test_a_neck_that_cannot_follow_goes_on_nonetheless() -> None:
    neck, around = Neck(stiff=True), _around()
    directions = {tuple(neck.look(around, UNSEEN)[0].round(6)) for _ in range(round(2 * LONGEST_S / STEP_DT) + 5)}
    assert len(directions) == len(GLANCES) + 1


@pytest.mark.parametrize("name", [name for name in all_tasks() if not get_task(name).searched])
def test_the_gaze_of_other_tasks_stays(name: str) -> None:
    around = LookAround(get_task(name), 1)
    around.begin(np.array([0]))
    never = np.full((1, len(get_task(name).objects)), np.inf)
    target = np.array([[1.0, 0.2, 0.1]])
    for _ in range(3):
        np.testing.assert_array_equal(around.targets(cast(Simulation, Neck()), np.array([0]), target, never), target)


def test_an_episode_that_begins_takes_no_glance_away_from_others() -> None:
    task, rows = get_task("CarryBox"), np.arange(2)
    starts = [task.sample("R3", np.random.default_rng(seed)) for seed in (970001, 970003)]

    def told(begun_again: bool) -> np.ndarray:
        sim = Simulation(task, 2, controller=HoldController(2))
        eyes = Sight(sim, "model")
        sim.reset(starts)
        eyes.begin(rows, starts)
        seen = []
        for step in range(6):
            if begun_again and step == 3:
                sim.reset(starts[:1], rows[:1])
                eyes.begin(rows[:1], starts[:1])
            sim.step(sim.command)
            eyes.look(rows)
            seen.append(eyes.environment_state()[1])
        assert np.isinf(eyes.estimate.age_s[1, 1])  # it still looks for the goal
        eyes.close()
        sim.close()
        return np.array(seen)

    np.testing.assert_array_equal(told(begun_again=False), told(begun_again=True))


@pytest.mark.parametrize(("searched", "is_found"), [(("goal",), True), ((), False)])
def test_a_tracker_finds_the_table_beside_the_robot_only_where_the_neck_looks_around(
    searched: tuple[str, ...], is_found: bool
) -> None:
    """Drawn pictures of CarryBox, of a robot that stands: within 2.5 s, and where the table is."""
    task = replace(get_task("CarryBox"), searched=searched)
    start = task.sample("R3", np.random.default_rng(970001))
    sim = Simulation(task, 1)
    sim.reset([start])
    eyes, rows = Sight(sim, "rgbd"), np.array([0])
    try:
        eyes.begin(rows, [start])
        for _ in range(25):
            sim.step(sim.command)
            eyes.look(rows)
        assert bool(np.isfinite(eyes.estimate.age_s[0, 1])) == is_found
        if is_found:
            told = sim.pose("head_camera")[0] @ eyes.estimate.T_camera_object[0, 1]
            assert np.linalg.norm(told[:3, 3] - sim.pose("goal")[0, :3, 3]) < 0.05
    finally:
        eyes.close()
        sim.close()
