"""A demonstration and one world -> its commands, stage after stage: locomotion, pre-manipulation, manipulation.

A stage is a Python generator: it looks at its world, yields one command, and is resumed after the world has made that
step. So stages of many worlds run side by side in one simulation. A stage that cannot go on raises ``StageError``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstration import Demonstration
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.world import World
from lerobot_demohlm.segmentation import Segment, groups

LOCOMOTION, PRE_MANIPULATION, MANIPULATION = "locomotion", "pre_manipulation", "manipulation"
STAGES = (LOCOMOTION, PRE_MANIPULATION, MANIPULATION)


@dataclass(frozen=True, kw_only=True)
class LocomotionSettings:
    """The PD controller that walks the base to its goal.

    Attributes:
        position_gain: Velocity a metre of error [1/s].
        yaw_gain: Yaw rate a radian of error [1/s].
        damping: Share of the measured velocity that is taken off the command.
        max_velocity: Fastest forward, backward, sideways [m/s] and yaw rate [rad/s].
        standoff: Metres to stay back from the goal for a metre of sideways error: turn and line up first, then step in.
        standoff_yaw: The same for a radian of heading error.
        max_standoff: Most of it [m].
        free_error: Sideways error for which nothing is held back [m].
        tolerance_m: Stop walking within this distance of the goal,
        tolerance_rad: and within this heading error.
        accept_m: Go on to the next stage with at most this distance once the robot stands still,
        accept_rad: and this heading error; otherwise walk again.
        settle_ticks: Ticks to stand still after walking; the controller squares up its feet meanwhile.
        max_walks: Times to walk before giving up.
        max_ticks: Longest locomotion stage.
    """

    position_gain: float = 1.2
    yaw_gain: float = 1.4
    damping: float = 0.1
    max_velocity: tuple[float, float, float, float] = (0.45, 0.25, 0.25, 0.5)
    standoff: float = 1.2
    standoff_yaw: float = 0.35
    max_standoff: float = 0.25
    free_error: float = 0.05
    tolerance_m: float = 0.03
    tolerance_rad: float = 0.06
    accept_m: float = 0.06
    accept_rad: float = 0.14
    settle_ticks: int = 12
    max_walks: int = 4
    max_ticks: int = 140


@dataclass(frozen=True, kw_only=True)
class PlaybackSettings:
    """How the hands follow the demonstration.

    Attributes:
        transit_speed: Mean speed of the hands on their way to the first target [m/s].
        min_transit_ticks: Shortest transit.
        reach_error_m: Largest distance of a palm from its target, by kinematics, at the switch to manipulation.
        hold_error_m: The same during manipulation, where a robot that stands a little off may trail.
        hold_ticks: How long it may last.
        displaced_m: An object pushed further than this before the hands take it was run into.
        final_ticks: Ticks to hold the last command after the demonstration has ended.
    """

    transit_speed: float = 0.3
    min_transit_ticks: int = 5
    reach_error_m: float = 0.06
    hold_error_m: float = 0.15
    hold_ticks: int = 10
    displaced_m: float = 0.06
    final_ticks: int = 5


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All of the above."""

    locomotion: LocomotionSettings = field(default_factory=LocomotionSettings)
    playback: PlaybackSettings = field(default_factory=PlaybackSettings)


class StageError(Exception):
    """A stage that cannot go on.

    Args:
        outcome: One of the outcomes of an attempt.
    """

    def __init__(self, outcome: str) -> None:
        super().__init__(outcome)
        self.outcome = outcome


def choose_placement(
    world: World, task: Task, demonstration: Demonstration, segments: Sequence[Segment]
) -> retarget.Placement:
    """Choose from where to act on the first object that a hand goes to."""
    first = min((entry for entry in segments if entry.kind == "object"), key=lambda entry: entry.start)
    assert first.object is not None  # object segments have one
    index = [entry.name for entry in task.objects].index(first.object)
    T_W_Od, T_W_Rd = demonstration.T_world_objects[first.start, index], demonstration.T_world_pelvis[0]
    distance = float(np.linalg.norm(T_W_Od[:2, 3] - T_W_Rd[:2, 3]))
    return retarget.choose_placement(
        task.object(first.object).symmetry,
        T_W_Rd=T_W_Rd,
        T_W_Od=T_W_Od,
        T_W_O=world.pose(first.object),
        T_W_R=world.pose("pelvis"),
        clearance_m=0.9 * distance,
    )


def locomotion(world: World, goal: np.ndarray, settings: LocomotionSettings) -> Iterator[np.ndarray]:
    """Walk until the base stands at its goal (x, y, yaw); fails with "off_course" where it does not get there."""
    ticks, before = 0, poses.to_planar(world.pose("pelvis"))
    for _ in range(settings.max_walks):
        while ticks < settings.max_ticks:
            here = poses.to_planar(world.pose("pelvis"))
            distance, turn = _errors(here, goal)
            if distance < settings.tolerance_m and abs(turn) < settings.tolerance_rad:
                break
            yield _with_velocity(walk_velocity(here, before, goal, settings))
            before, ticks = here, ticks + 1
        for _ in range(settings.settle_ticks):
            yield _with_velocity(np.zeros(3))
            ticks += 1
        before = poses.to_planar(world.pose("pelvis"))
        distance, turn = _errors(before, goal)
        if distance < settings.accept_m and abs(turn) < settings.accept_rad:
            return
        if ticks >= settings.max_ticks:
            break
    raise StageError("off_course")


def walk_velocity(
    here: np.ndarray, before: np.ndarray, goal: np.ndarray, settings: LocomotionSettings, dt: float = 0.1
) -> np.ndarray:
    """Return the PD controller's velocity command (3,) in the heading frame [m/s, m/s, rad/s].

    Args:
        here: (3,) x, y, yaw of the base [m, m, rad].
        before: (3,) the same one tick ago.
        goal: (3,) where it should be.
        settings: Gains and limits.
        dt: Tick [s].
    """
    back = poses.planar(*goal)[:2, 0]
    offset = goal[:2] - here[:2]
    sideways = abs(float(offset @ np.array([-back[1], back[0]])))
    turn = float(poses.wrap_angle(goal[2] - here[2]))
    hold = settings.standoff * max(0.0, sideways - settings.free_error)
    hold += settings.standoff_yaw * max(0.0, abs(turn) - 0.1)
    offset = offset - min(hold, settings.max_standoff) * back
    R = poses.planar(0.0, 0.0, here[2])[:2, :2]
    velocity = (here[:2] - before[:2]) / dt
    rate = float(poses.wrap_angle(here[2] - before[2])) / dt
    linear = R.T @ (settings.position_gain * offset - settings.damping * velocity)
    angular = settings.yaw_gain * turn - settings.damping * rate
    forward, backward, side, yaw_rate = settings.max_velocity
    linear = np.clip(linear, [-backward, -side], [forward, side])
    return np.array([linear[0], linear[1], np.clip(angular, -yaw_rate, yaw_rate)])


def _errors(here: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    offset = goal - here
    return float(np.hypot(offset[0], offset[1])), float(poses.wrap_angle(offset[2]))


def _with_velocity(velocity: np.ndarray) -> np.ndarray:
    walking = command.rest()
    walking[command.VELOCITY] = velocity
    return walking


@dataclass
class HandPlan:
    """Targets of both hands, computed segment by segment as the switches come.

    Attributes:
        targets: (T, 2, 4, 4) of the demonstration; rows are filled in when their segment starts.
        last: (2, 4, 4) last commanded targets.
    """

    targets: np.ndarray
    last: np.ndarray


class Playback:
    """The demonstration's hand motion, carried over to where robot and objects are.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        segments: Its segments.
        symmetry: (4, 4) the chosen symmetry of the first object.
        settings: Limits and times.

    Attributes:
        stage: "pre_manipulation" or "manipulation".
    """

    def __init__(
        self,
        world: World,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        symmetry: np.ndarray,
        settings: PlaybackSettings,
    ) -> None:
        self.world, self.task, self.demonstration, self.settings = world, task, demonstration, settings
        self.stage = PRE_MANIPULATION
        self._names = [entry.name for entry in task.objects]
        self._groups = groups(segments)
        self._symmetries = {self._groups[0][0].object: symmetry}
        self._tracks = {hand: [entry for entry in segments if entry.hand == hand] for hand in g1.SIDES}
        self._targets = np.tile(np.eye(4), (len(demonstration), len(g1.SIDES), 1, 1))
        self._last = world.hands()  # where the hands are stands in for the first commanded target
        self._trailing = 0

    def run(self) -> Iterator[np.ndarray]:
        """Yield commands until the demonstration is over."""
        for tick in range(len(self.demonstration)):
            starting = [group for group in self._groups if group[0].start == tick]
            for group in starting:
                self._start(group)
            if any(entry.kind == "object" for group in starting for entry in group) or tick == 0:
                yield from self._transit(tick)
            if self.stage == PRE_MANIPULATION and self._touching(tick):
                self._check_reached()
                self.stage = MANIPULATION
            yield self._command(self._targets[tick], tick)
        last = self.world.command()
        for _ in range(self.settings.final_ticks):
            yield last

    def _start(self, group: tuple[Segment, ...]) -> None:
        """Fill in the targets of segments that begin together."""
        hands = [g1.SIDES.index(entry.hand) for entry in group]
        first = group[0]
        ticks = slice(first.start, max(entry.stop for entry in group))
        demonstrated = self.demonstration.T_world_targets[ticks][:, hands]
        if first.kind == "object":
            assert first.object is not None  # object segments have one
            T_W_Od = self.demonstration.T_world_objects[first.start, self._names.index(first.object)]
            T_W_O = self.world.pose(first.object)
            symmetry = self._symmetry(first.object, T_W_Od, T_W_O, first.start)
            targets = retarget.object_targets(demonstrated, T_W_Od, T_W_O, symmetry)
        else:
            before = max(first.start - 1, 0)
            last_d = self.demonstration.T_world_targets[before][hands]
            T_W_Rd, T_W_R = self.demonstration.T_world_pelvis[first.start], self.world.pose("pelvis")
            if first.start == 0:  # a hand that follows the robot from the beginning keeps its place on it
                last = retarget.object_targets(last_d, poses.heading(T_W_Rd), poses.heading(T_W_R), np.eye(4))
            else:
                last = self._last[hands]
            targets = retarget.anchored_targets(
                demonstrated,
                last_d,
                last,
                retarget.anchor_pose(first.anchor, last_d, T_W_Rd),
                retarget.anchor_pose(first.anchor, last, T_W_R),
            )
        for column, (hand, entry) in enumerate(zip(hands, group, strict=True)):
            self._targets[entry.start : entry.stop, hand] = targets[: entry.stop - entry.start, column]

    def _symmetry(self, name: str, T_W_Od: np.ndarray, T_W_O: np.ndarray, tick: int) -> np.ndarray:
        if name not in self._symmetries:
            self._symmetries[name] = retarget.choose_placement(
                self.task.object(name).symmetry,
                T_W_Rd=self.demonstration.T_world_pelvis[tick],
                T_W_Od=T_W_Od,
                T_W_O=T_W_O,
                T_W_R=self.world.pose("pelvis"),
            ).symmetry
        return self._symmetries[name]

    def _transit(self, tick: int) -> Iterator[np.ndarray]:
        """Bring the hands from where they are commanded, at first from where they are, to this tick's targets."""
        distance = np.linalg.norm(self._targets[tick, :, :3, 3] - self._last[:, :3, 3], axis=-1).max()
        ticks = max(self.settings.min_transit_ticks, int(np.ceil(10.0 * distance / self.settings.transit_speed)))
        for targets in retarget.transit(self._last, self._targets[tick], ticks):
            yield self._command(targets, tick)

    def _touching(self, tick: int) -> bool:
        return any(
            entry.kind == "proprioception" and entry.object is not None and entry.start <= tick
            for track in self._tracks.values()
            for entry in track
        )

    def _command(self, targets: np.ndarray, tick: int) -> np.ndarray:
        solution = self.world.ik.solve(
            T_world_pelvis=self.world.pose("pelvis"),
            joint_positions=self.world.joint_positions(),
            T_world_left=targets[0],
            T_world_right=targets[1],
            previous=self.world.command(),
        )
        self._last = targets
        self._error = solution.position_error
        self._trailing = self._trailing + 1 if self._error.max() > self.settings.hold_error_m else 0
        if self.stage == MANIPULATION and self._trailing >= self.settings.hold_ticks:
            raise StageError("ik_failed")
        if self.stage == PRE_MANIPULATION:
            for name in self._names:
                if self.world.object_displacement(name) > self.settings.displaced_m:
                    raise StageError("collided")
        result = solution.command
        result[command.GRIPPERS] = self.demonstration.action[tick, command.GRIPPERS]
        return result

    def _check_reached(self) -> None:
        if self._error.max() > self.settings.reach_error_m:
            raise StageError("ik_failed")
