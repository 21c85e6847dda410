"""A stage that fails before anything is held may be tried again: hands go back, the robot steps back and returns."""

import dataclasses

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik_settings import IKSettings
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.simulation.judge import held
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation import attempt, stages
from lerobot_demohlm.generation.attempt import Attempt, Attempts
from lerobot_demohlm.generation.locomotion import LocomotionSettings
from lerobot_demohlm.generation.stages import Settings

TASK = get_task("GraspCube")
RIGHT = command.GRIPPERS.start + 1


def tries(retries: int) -> Settings:
    """Return settings whose attempts carry no noise and may begin again."""
    return Settings(variation=dataclasses.replace(PLAIN, retries=retries))


class Jammed(Simulation):
    """A robot whose right gripper does not close the first time that it is told to."""

    def reset(self, *arguments: object, **options: object) -> None:
        super().reset(*arguments, **options)  # pyright: ignore[reportArgumentType]
        self.told, self.freed = False, False

    def step(self, commands: np.ndarray, active: np.ndarray | None = None) -> StepResult:
        closing = bool(commands[0, RIGHT] > 0.5)
        self.freed |= self.told and not closing
        self.told |= closing
        if closing and not self.freed:
            commands = commands.copy()
            commands[0, RIGHT] = 0.0
        return super().step(commands, active)


class Demanding(Simulation):
    """A task that has no success before the robot has stepped back once."""

    def reset(self, *arguments: object, **options: object) -> None:
        super().reset(*arguments, **options)  # pyright: ignore[reportArgumentType]
        self.stepped_back = False

    def step(self, commands: np.ndarray, active: np.ndarray | None = None) -> StepResult:
        self.stepped_back |= bool(commands[0, 0] < -0.05)
        return super().step(commands, active)

    def success(self) -> np.ndarray:
        return super().success() & self.stepped_back


def one_attempt(name: str, variation: str, index: int = 0) -> Episode:
    task = get_task(name)
    settings = Settings(variation=dataclasses.replace(PLAIN, variation=variation))
    attempts = Attempts(task, demonstrations.load(task=task), "R1", 0, settings=settings)
    (episode,) = attempts.run([index])
    attempts.close()
    return episode


def jammed(monkeypatch: pytest.MonkeyPatch, retries: int) -> Episode:
    monkeypatch.setattr(attempt, "Simulation", Jammed)
    attempts = Attempts(TASK, demonstrations.load(task=TASK), "R1", 0, settings=tries(retries))
    (episode,) = attempts.run([0])
    attempts.close()
    return episode


def test_without_retries_a_missed_grip_is_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = jammed(monkeypatch, 0)
    assert (episode.outcome, episode.stage, episode.retries) == ("dropped", stages.MANIPULATION, 0)


def test_a_missed_grip_is_tried_again_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = jammed(monkeypatch, 1)
    assert (episode.outcome, episode.retries, episode.record()["retries"]) == ("success", 1, 1)
    walking = np.abs(episode.action[:, command.VELOCITY]).max(axis=1) > 0.0
    begins = np.flatnonzero(np.diff(walking.astype(int)) == 1) + 1
    closed = np.flatnonzero(np.diff((episode.action[:, RIGHT] > 0.5).astype(int)) == 1) + 1
    assert len(closed) == 2
    back = [tick for tick in begins if closed[0] < tick < closed[1]]
    assert len(back) >= 2  # back and forth again
    assert episode.action[back[0], 0] < 0.0
    assert np.abs(np.diff(episode.action[:, command.ARMS], axis=0)).max() < 0.45  # rad a tick: no jerk


def test_each_try_that_walks_past_its_goal_counts() -> None:
    impatient = dataclasses.replace(tries(2), locomotion=LocomotionSettings(max_ticks=5))
    attempts = Attempts(TASK, demonstrations.load(task=TASK), "R3", 0, settings=impatient)
    (episode,) = attempts.run([0])
    attempts.close()
    assert (episode.outcome, episode.stage, episode.retries) == ("off_course", stages.LOCOMOTION, 2)


def test_hands_that_cannot_reach_are_taken_back_the_way_they_came() -> None:
    demonstration = demonstrations.load(task=TASK)
    targets = demonstration.hand_targets.copy()
    targets[:, 1, 2] += 1.0
    unreachable = dataclasses.replace(demonstration, hand_targets=targets)
    attempts = Attempts(TASK, unreachable, "R1", 0, settings=tries(1))
    (episode,) = attempts.run([0])
    attempts.close()
    assert (episode.outcome, episode.stage, episode.retries) == ("ik_failed", stages.PRE_MANIPULATION, 1)


@pytest.mark.parametrize(
    ("name", "index", "variation", "ended"),
    [
        ("PressCube", 3, "real:start", ("success", 1)),
        ("PressCube", 0, "none", ("timeout", 0)),
        ("GraspCube", 0, "real:start", ("timeout", 0)),  # the cube is in the hand
    ],
)
def test_a_motion_without_success_is_made_again_where_nothing_was_taken(
    monkeypatch: pytest.MonkeyPatch, name: str, index: int, variation: str, ended: tuple[str, int]
) -> None:
    """In worlds that vary."""
    monkeypatch.setattr(attempt, "Simulation", Demanding)
    episode = one_attempt(name, variation, index)
    assert (episode.outcome, episode.retries) == ended


@pytest.mark.parametrize("variation", ["real:start", "none"])
def test_in_worlds_that_vary_an_attempt_ends_with_its_success(variation: str) -> None:
    """As an episode of the environment does; in the plain world the whole demonstration is repeated."""
    episode = one_attempt("PressCube", variation)
    assert episode.outcome == "success" and held(episode.success)
    assert held(episode.success[:-1]) == (variation == "none")


def test_worlds_that_vary_have_their_own_limits_and_no_fewer_tries_than_asked() -> None:
    plain, varied = (Settings(variation=dataclasses.replace(PLAIN, variation=name)) for name in ("none", "real:robot"))
    assert (plain.gripping, plain.ik, plain.retries) == (plain.grip, IKSettings(), 0)
    assert varied.gripping == dataclasses.replace(plain.grip, grip_n=varied.adaptation.grip_n)
    assert varied.ik == IKSettings(highest=varied.adaptation.highest_m)
    assert varied.retries == varied.adaptation.retries
    more = varied.adaptation.retries + 1
    assert dataclasses.replace(varied, variation=dataclasses.replace(varied.variation, retries=more)).retries == more


@pytest.mark.parametrize("name", ["real@0", "hard@0.0:objects", "none@1", "none:objects"])
def test_worlds_by_whose_name_nothing_varies_are_plain(name: str) -> None:
    variation = dataclasses.replace(PLAIN, variation=name)
    assert variation == PLAIN and variation.content() == PLAIN.content()
    assert not Settings(variation=variation).adapts
    assert Settings(variation=dataclasses.replace(PLAIN, variation="real@0.01")).adapts


@pytest.mark.parametrize(("variation", "tilt"), [("real:start", 0.0), ("real:start", np.pi / 2), ("none", 0.0)])
def test_a_thing_that_was_pushed_away_is_taken_where_it_is(variation: str, tilt: float) -> None:
    """In worlds that vary, and if it still stands as it did."""
    pushed: list[int] = []

    def push(attempt: Attempt, _: np.ndarray) -> None:
        if attempt.stage == stages.PRE_MANIPULATION and not pushed:
            sim, tilted = attempt.world.sim, poses.from_rotation(poses.rotation_from_rpy([tilt, 0.0, 0.0]), np.zeros(3))
            pushed.append(len(attempt.action))
            sim.set_pose("cube", poses.pose([-0.02, 0.07, 0.0]) @ sim.pose("cube") @ tilted, np.array([0]))

    settings = Settings(variation=dataclasses.replace(PLAIN, variation=variation))
    attempts = Attempts(TASK, demonstrations.load(task=TASK), "R1", 0, settings=settings, on_command=push)
    (episode,) = attempts.run([0])
    attempts.close()
    again = variation != "none" and tilt == 0.0
    assert (episode.outcome, episode.retries) == (("success", 1) if again else ("collided", 0))
    if not again:
        assert "the cube was pushed 0.07" in episode.reason
