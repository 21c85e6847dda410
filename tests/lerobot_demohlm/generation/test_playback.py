"""Playback leads hands to where they were in the demonstration, and grippers close only where that leads to a grip."""

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import IKSolution
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation.playback import Playback
from lerobot_demohlm.generation.stages import GripSettings, PlaybackSettings, Settings, StageError
from lerobot_demohlm.generation.world_view import WorldView

SAG = np.array([0.0, 0.004, -0.015])  # m


class FakeWorld:
    """A robot that stands where the demonstrated one did and whose hands are at their targets, but for a sag."""

    def __init__(self, demonstration: Demonstration, grip_n: float = 0.0, raised: float = 0.0) -> None:
        self.demonstration, self.grip_n = demonstration, grip_n
        self.shift = poses.pose([0.0, 0.0, raised])  # of the objects
        self.names = [entry.name for entry in get_task(demonstration.task).objects]
        self.asked = demonstration.T_world_hands[0].copy()
        self.last, self.pushed = command.rest(), np.eye(4)
        self.ik = SimpleNamespace(solve=self.solve)

    def solve(self, *, T_world_left: np.ndarray, T_world_right: np.ndarray, **_: object) -> IKSolution:
        self.asked = np.stack([T_world_left, T_world_right])
        zero = np.zeros(2)
        return IKSolution(
            command=self.last.copy(), position_error=zero, orientation_error=zero, planned_position_error=zero
        )

    def hands(self) -> np.ndarray:
        measured = self.asked.copy()
        measured[:, :3, 3] += SAG
        return measured

    def pose(self, name: str) -> np.ndarray:
        if name == "pelvis":
            return self.demonstration.T_world_pelvis[0] @ self.pushed
        return self.shift @ self.demonstration.T_world_objects[0, self.names.index(name)]

    def start_pose(self, name: str) -> np.ndarray:
        return self.pose(name)

    def command(self) -> np.ndarray:
        return self.last

    def joint_positions(self) -> np.ndarray:
        return g1.HOME

    def contact_force(self, hand: str, name: str) -> float:
        return self.grip_n


def playback(world: FakeWorld, settings: Settings) -> Playback:
    demonstration = world.demonstration
    task = get_task(demonstration.task)
    return Playback(
        cast(WorldView, world),
        task,
        demonstration,
        segment(demonstration, task),
        np.eye(4),
        settings,
    )


@pytest.mark.parametrize(("gain", "least", "most"), [(0.0, 0.014, 0.03), (0.1, 0.0, 0.006)])
def test_hands_are_led_to_where_they_were_beside_the_object(gain: float, least: float, most: float) -> None:
    """The demonstrated hands trailed their targets by less than these sag: leading makes up for the difference."""
    demonstration = demonstrations.load(task=get_task("LiftBox"))
    targets = demonstration.hand_targets.copy()
    targets[:] = targets[30]  # hands that wait
    still = dataclasses.replace(demonstration, hand_targets=targets, hand_poses=targets)
    world = FakeWorld(still)
    settings = Settings(playback=PlaybackSettings(steering_gain=gain))
    switch = max(entry.stop for entry in segment(still, get_task(still.task)) if entry.kind == "object")
    seen = []
    for _ in playback(world, settings).run():
        seen.append(np.linalg.norm(world.hands()[:, :3, 3] - still.T_world_hands[0, :, :3, 3], axis=-1).max())
    transit = len(seen) - len(still) - settings.playback.final_ticks
    assert least <= seen[transit + switch - 1] <= most
    assert seen[-1] == pytest.approx(seen[transit + switch], abs=1e-6)  # what was made up for stays


@pytest.mark.parametrize("raised", [-0.12, 0.0, 0.12])
def test_hands_join_a_motion_as_it_goes_on(raised: float) -> None:
    """At a lower table they do not go down first to come up again; they never jump; and they end where they should."""
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    approach = next(entry for entry in segment(demonstration, get_task(demonstration.task)) if entry.kind == "object")
    still = Settings(playback=PlaybackSettings(steering_gain=0.0), grip=GripSettings(settle_ticks=0))
    made = playback(FakeWorld(demonstration, 10.0, raised), still)
    commands = made.run()
    way = [made.last_targets[1]]
    while made.tick < approach.stop - 1:
        next(commands)
        way.append(made.last_targets[1])
    assert len(way) == approach.stop + 1  # no time is lost before the motion
    heights = np.array(way)[:, 2, 3]
    wanted = demonstration.T_world_targets[: approach.stop, 1, 2, 3] + raised
    assert heights[-1] == pytest.approx(wanted[-1], abs=1e-9)
    assert heights.min() > min(heights[0], wanted[-1]) - 0.01
    steps = np.linalg.norm(np.diff(np.array(way)[:, :3, 3], axis=0), axis=-1)
    demonstrated = np.linalg.norm(np.diff(demonstration.T_world_targets[: approach.stop, 1, :3, 3], axis=0), axis=-1)
    assert steps.max() < demonstrated.max() + 0.02  # m a tick


@pytest.mark.parametrize(
    ("left", "waited"),
    [([0.05, 0.04, 0.03, 0.005], 3), ([0.05] * 10, 4), ([0.05] * 3 + [0.04] * 10, 7), ([0.005], 0)],
    ids=["until the torso is there", "no gain", "a gain, then none", "there"],
)
def test_a_motion_waits_for_the_torso(left: list[float], waited: int) -> None:
    """As long as hands close to an object come nearer to where they should be; not far from it, nor holding it."""
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    approach = next(entry for entry in segment(demonstration, get_task(demonstration.task)) if entry.kind == "object")
    far, close, after = 5, approach.stop - 3, approach.stop + 10
    world = FakeWorld(demonstration, 10.0)
    made = playback(world, Settings())
    asked = []  # the ticks that commands were for, as they are found

    def solve(*, T_world_left: np.ndarray, T_world_right: np.ndarray, **_: object) -> IKSolution:
        following = made.tick + (made.activity != "wait")
        asked.append(following)
        here = asked.count(following) - 1 if following in (far, close, after) else -1
        error = left[min(here, len(left) - 1)] if here >= 0 else 0.0
        solution = world.solve(T_world_left=T_world_left, T_world_right=T_world_right)
        return dataclasses.replace(solution, position_error=np.array([0.0, error]))

    world.ik = SimpleNamespace(solve=solve)
    waits = [made.tick for _ in made.run() if made.activity == "wait"]
    assert waits == [close] * waited


@pytest.mark.parametrize(("raised", "higher"), [(-0.1, 0.0), (0.0, 0.0), (0.15, 0.15)])
def test_what_is_taken_higher_up_is_lifted_higher(raised: float, higher: float) -> None:
    """From lower down it ends where the demonstrated lift did: at the body."""
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    still = Settings(playback=PlaybackSettings(steering_gain=0.0), grip=GripSettings(settle_ticks=0))
    made = playback(FakeWorld(demonstration, 10.0, raised), still)
    for _ in made.run():
        pass
    ended = made.last_targets[1, 2, 3] - demonstration.T_world_targets[-1, 1, 2, 3]
    assert ended == pytest.approx(higher, abs=1e-9)


@pytest.mark.parametrize("watched", [True, False])
def test_a_base_that_is_not_watched_is_thought_to_move_as_demonstrated(watched: bool) -> None:
    """A push that moves the robot aside moves its hands with it where nobody looks."""
    demonstration = demonstrations.load(task=get_task("LiftBox"))
    made = playback(world := FakeWorld(demonstration), Settings(playback=PlaybackSettings(watches_base=watched)))
    seen: list[np.ndarray] = []
    world.ik = SimpleNamespace(
        solve=lambda T_world_pelvis, **targets: seen.append(T_world_pelvis[:2, 3]) or world.solve(**targets)
    )
    pushed = poses.planar(0.0, 0.05, 0.0)
    for index, _ in enumerate(made.run()):
        if index == 5:
            world.pose = lambda name: (pushed if name == "pelvis" else np.eye(4)) @ FakeWorld.pose(world, name)
        if made.tick == 15:
            break
    moved = seen[-1] - (FakeWorld.pose(world, "pelvis") if watched else demonstration.T_world_pelvis[15])[:2, 3]
    np.testing.assert_allclose(moved, [0.0, 0.05 if watched else 0.0], atol=1e-9)


def test_hands_go_to_a_motion_first_where_it_leaves_no_time() -> None:
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    hasty = Settings(playback=PlaybackSettings(steering_gain=0.0, joining_share=0.0))
    made = playback(FakeWorld(demonstration, 10.0, -0.3), hasty)
    activities = []
    for _ in made.run():
        activities.append(made.activity)
        if made.tick > 0:
            break
    assert activities[:-2] == ["transit"] * 10  # 0.3 m at 0.3 m/s
    assert made.last_targets[1, 2, 3] == pytest.approx(demonstration.T_world_targets[1, 1, 2, 3] - 0.3, abs=1e-9)


@pytest.mark.parametrize("both", [False, True])
def test_hands_that_follow_the_base_stay_there_while_others_join(both: bool) -> None:
    """From the first tick on, one hand while the other goes to its object, or both until one does."""
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    length, begin = len(demonstration), 10 if both else 0
    base = {"kind": "proprioception", "object": None, "anchor": "base"}
    segments = [
        Segment(hand="left", start=0, stop=length, **base),
        *([Segment(hand="right", start=0, stop=begin, **base)] if both else []),
        Segment(hand="right", kind="object", start=begin, stop=50, object="cube"),
        Segment(hand="right", kind="proprioception", start=50, stop=length, object="cube", anchor="body"),
    ]
    world, settings = FakeWorld(demonstration, 10.0), Settings(playback=PlaybackSettings(joining_share=0.0))
    made = Playback(cast(WorldView, world), get_task("GraspCube"), demonstration, segments, np.eye(4), settings)
    activities = []
    for _ in made.run():
        activities.append(made.activity)
        np.testing.assert_allclose(
            made.last_targets[0, :3, 3], world.demonstration.T_world_hands[0, 0, :3, 3], atol=0.03
        )
    assert activities.index("transit") == begin


@pytest.mark.parametrize("grip_n", [0.0, 10.0])
def test_a_gripper_waits_until_it_is_there_and_must_press(grip_n: float) -> None:
    demonstration = demonstrations.load(task=get_task("ExchangeCube"))
    world = FakeWorld(demonstration, grip_n)
    settings = Settings(grip=GripSettings(settle_ticks=25))
    closed = []
    error = np.inf
    try:
        for wanted in playback(world, settings).run():
            if not any(closed) and wanted[command.GRIPPERS][1] < 0.5:
                here = world.hands()[1, :3, 3]
                error = float(np.linalg.norm(demonstration.T_world_hands[:, 1, :3, 3] - here, axis=-1).min())
            closed.append(wanted[command.GRIPPERS][1] > 0.5)
            world.last = wanted
        outcome = "finished"
    except StageError as failure:
        outcome = failure.outcome
    assert outcome == ("finished" if grip_n else "dropped")
    assert error < 2 * settings.grip.settle_m
    assert sum(closed) > (0 if not grip_n else 50)


@pytest.mark.parametrize(("varies", "comes_back"), [(True, True), (True, False), (False, False)])
def test_hands_wait_while_a_base_that_was_pushed_comes_back(varies: bool, comes_back: bool) -> None:
    """In worlds that vary; one that does not come back is waited for no longer than the settings say."""
    demonstration = demonstrations.load(task=get_task("GraspCube"))
    settings = Settings(variation=dataclasses.replace(PLAIN, variation="real" if varies else "none"))
    world = FakeWorld(demonstration, 10.0)
    made = playback(world, settings)
    seen = []
    for wanted in made.run():
        seen.append((made.tick, made.activity, bool(wanted[command.VELOCITY].any())))
        waited = sum(activity == "regain" for _, activity, _ in seen)
        world.pushed = poses.planar(-0.15 if made.tick >= 10 and not (comes_back and waited > 20) else 0.0, 0.0, 0.0)
        if made.tick > 25:
            break
    waits = [steps for _, activity, steps in seen if activity == "regain"]
    assert len(waits) == 0 if not varies else 20 < len(waits) <= settings.adaptation.regain_ticks
    assert (len(waits) == settings.adaptation.regain_ticks) == (varies and not comes_back)
    assert sum(waits) >= len(waits) - 1  # all but the last of them are steps
    assert any(steps for *_, steps in seen) == varies
    assert seen[-1][2] == (varies and not comes_back)
