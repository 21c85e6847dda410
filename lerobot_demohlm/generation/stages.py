"""A demonstration and one world -> its commands, stage after stage: locomotion, pre-manipulation, manipulation.

A stage is a Python generator: it looks at its world, yields one command, and is resumed after the world has made that
step. So stages of many worlds run side by side in one simulation. A stage that cannot go on raises ``StageError``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command, reference
from gym_demohlm.task import Task
from lerobot_demohlm.demonstration import Demonstration
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.world import World
from lerobot_demohlm.segmentation import Segment

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
        window_ticks: Ticks over which the base is averaged, a period of the gait, whose sway is no error.
        coast_s: How long the robot goes on at its speed once it is told to stand [s].
        standoff: Metres to stay back from the goal for a metre of sideways error: turn and line up first, then step in.
        standoff_yaw: The same for a radian of heading error.
        max_standoff: Most of it [m].
        free_error: Sideways error for which nothing is held back [m].
        tolerance_m: Stop walking where it would come to stand within this distance of the goal,
        tolerance_rad: and within this heading error.
        accept_m: Go on to the next stage with at most this distance once the robot stands still,
        accept_rad: and this heading error; otherwise walk again.
        settle_ticks: Ticks to stand still after walking; the controller squares up its feet meanwhile.
        max_walks: Times to walk before giving up.
        max_ticks: Longest locomotion stage.
    """

    position_gain: float = 1.2
    yaw_gain: float = 1.4
    damping: float = 0.3
    max_velocity: tuple[float, float, float, float] = (0.45, 0.25, 0.25, 0.5)
    window_ticks: int = 7
    coast_s: float = 0.4
    standoff: float = 1.2
    standoff_yaw: float = 0.35
    max_standoff: float = 0.25
    free_error: float = 0.05
    tolerance_m: float = 0.03
    tolerance_rad: float = 0.05
    accept_m: float = 0.05
    accept_rad: float = 0.12
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


class BaseEstimate:
    """Where the base is and how fast it goes, with the sway of the gait averaged out.

    Args:
        window_ticks: Period of the gait.
        dt: Tick [s].

    Attributes:
        position: (3,) x, y, yaw now [m, m, rad].
        velocity: (3,) in the world [m/s, m/s, rad/s].
    """

    def __init__(self, window_ticks: int, dt: float = 0.1) -> None:
        self._window, self._dt = window_ticks, dt
        self._seen: list[np.ndarray] = []
        self.position, self.velocity = np.zeros(3), np.zeros(3)

    def update(self, T_world_pelvis: np.ndarray) -> None:
        """Take in the pose of this tick."""
        here = poses.to_planar(T_world_pelvis)
        if self._seen:
            here[2] = self._seen[-1][2] + poses.wrap_angle(here[2] - self._seen[-1][2])
        self._seen = [*self._seen[-self._window :], here]
        span = (len(self._seen) - 1) * self._dt
        if span > 0:
            self.velocity = (self._seen[-1] - self._seen[0]) / span
        self.position = np.mean(self._seen, axis=0) + 0.5 * span * self.velocity


def locomotion(world: World, goal: np.ndarray, settings: LocomotionSettings) -> Iterator[np.ndarray]:
    """Walk until the base stands at its goal (x, y, yaw); fails with "off_course" where it does not get there."""
    ticks = 0
    base = BaseEstimate(settings.window_ticks)
    base.update(world.pose("pelvis"))
    for _ in range(settings.max_walks):
        while ticks < settings.max_ticks:
            distance, turn = _errors(base.position + settings.coast_s * base.velocity, goal)
            velocity = walk_velocity(base.position, base.velocity, goal, settings)
            arrived = distance < settings.tolerance_m and abs(turn) < settings.tolerance_rad
            if arrived or (np.abs(velocity) < reference.WALK_THRESHOLD).all():  # so slow that it would stand
                break
            yield _with_velocity(velocity)
            ticks += 1
            base.update(world.pose("pelvis"))
        for _ in range(settings.settle_ticks):
            yield _with_velocity(np.zeros(3))
            ticks += 1
            base.update(world.pose("pelvis"))
        distance, turn = _errors(poses.to_planar(world.pose("pelvis")), goal)
        if distance < settings.accept_m and abs(turn) < settings.accept_rad:
            return
        if ticks >= settings.max_ticks:
            break
    raise StageError("off_course")


def walk_velocity(here: np.ndarray, velocity: np.ndarray, goal: np.ndarray, settings: LocomotionSettings) -> np.ndarray:
    """Return the PD controller's velocity command (3,) in the heading frame [m/s, m/s, rad/s].

    Args:
        here: (3,) x, y, yaw of the base [m, m, rad].
        velocity: (3,) of the base in the world [m/s, m/s, rad/s].
        goal: (3,) where it should be.
        settings: Gains and limits.
    """
    ahead = poses.planar(*goal)[:2, 0]
    offset = goal[:2] - here[:2]
    sideways = abs(float(offset @ np.array([-ahead[1], ahead[0]])))
    turn = float(poses.wrap_angle(goal[2] - here[2]))
    hold = settings.standoff * max(0.0, sideways - settings.free_error)
    hold += settings.standoff_yaw * max(0.0, abs(turn) - 0.1)
    offset = offset - min(hold, settings.max_standoff) * ahead
    R = poses.planar(0.0, 0.0, here[2])[:2, :2]
    linear = R.T @ (settings.position_gain * offset - settings.damping * velocity[:2])
    angular = settings.yaw_gain * turn - settings.damping * velocity[2]
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
