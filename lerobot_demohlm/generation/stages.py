"""A demonstration and one world -> its commands, stage after stage: locomotion, pre-manipulation, manipulation.

A stage is a Python generator: it looks at its world, yields one command, and is resumed after the world has made that
step. So stages of many worlds run side by side in one simulation. A stage that cannot go on raises ``StageError``.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.control.ik_settings import IKSettings
from gym_demohlm.task import Task
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.clearance import TOLERANCE_M, stand_clear, way_around
from lerobot_demohlm.generation.handing_over import HandingOverSettings
from lerobot_demohlm.generation.locomotion import LocomotionSettings, OffCourseError, walk
from lerobot_demohlm.generation.tables import TableSettings, tables_under
from lerobot_demohlm.generation.world_view import WorldView

LOCOMOTION, PRE_MANIPULATION, MANIPULATION = "locomotion", "pre_manipulation", "manipulation"
STAGES = (LOCOMOTION, PRE_MANIPULATION, MANIPULATION)
PASSING_M = 0.15  # that a robot keeps from a table on its way past it, beyond the distance from which it acts there
STANCE_STREAM = 2  # first number of its seed sequences, as GENERATION_STREAM is of initial states
STANCE_RANGES = np.array([[-0.05, 0.02], [-0.04, 0.04], [-0.08, 0.08]])  # m, m, rad: back rather than into a table


@dataclass(frozen=True, kw_only=True)
class PlaybackSettings:
    """How the hands follow the demonstration.

    Attributes:
        transit_speed: Mean speed of hands on their way to where an object's motion begins [m/s].
        min_transit_ticks: Least number of ticks of that way.
        joining_share: Share of a segment in which hands may join its motion while it goes on. Where this is too short
            for their way, they make it before the segment begins.
        close_m: Distance of a palm from the end of its approach below which the motion may wait for the torso.
        torso_error_m: Distance of such a palm from its target, by kinematics, above which the motion waits.
        torso_gain_m: Least decrease of that distance, in one tick, that counts as a gain.
        patience_ticks: Number of ticks without a gain after which the motion stops waiting.
        reach_error_m: Largest distance of a palm from its target, by kinematics, at the switch to manipulation.
        hold_error_m: Largest distance of a palm from its target, by kinematics, during manipulation. It is larger than
            ``reach_error_m``, as a robot that stands a little off may trail.
        hold_ticks: Number of ticks that a palm may be further from its target than ``hold_error_m``.
        steering_gain: Share of a hand's error by which its target moves in each tick while it follows an object.
        max_shift_m: Largest distance by which steering moves a target.
        path_gain: Velocity for an error of one metre or radian of the base's path while hands hold something: forward,
            sideways and turning [1/s].
        max_path_velocity: Largest change of the demonstrated velocity for the sake of the path [m/s, m/s, rad/s].
        walk_height: Least torso height while hands hold something and the base walks [m]; the controller does not step
            in a deep bend.
        walk_pitch: Largest torso pitch while hands hold something and the base walks [rad].
        arrive_m: Distance to the end of a walk at which the walk is done.
        arrive_ticks: Largest number of ticks to walk on where the end of a walk is further away than ``arrive_m``.
        displaced_m: Distance from which on an object that moved before the hands took it counts as run into.
        final_ticks: Ticks to hold the last command after the demonstration has ended.
        watches_base: Whether commands are found for where the base is at each tick. Otherwise it is looked at when a
            part of the motion begins, and thought to move as demonstrated from then on.
        far_up_m: Height above the demonstrated one from which on hands keep clear of their shoulders on the way to a
            thing that is on no table [m]; R1 to R3 do not reach it.
        shoulder_m: Distance that a palm then keeps from its shoulder [m].
        delicate_ticks: Ticks before and after a touch or a switch of a gripper in which commands carry no noise.
    """

    transit_speed: float = 0.3
    min_transit_ticks: int = 5
    joining_share: float = 0.35
    close_m: float = 0.1
    torso_error_m: float = 0.01
    torso_gain_m: float = 0.001
    patience_ticks: int = 4
    reach_error_m: float = 0.06
    hold_error_m: float = 0.15
    hold_ticks: int = 10
    steering_gain: float = 0.1
    max_shift_m: float = 0.03
    path_gain: tuple[float, float, float] = (1.0, 0.5, 0.5)
    max_path_velocity: tuple[float, float, float] = (0.2, 0.1, 0.2)
    walk_height: float = 0.69
    walk_pitch: float = 0.32
    arrive_m: float = 0.05
    arrive_ticks: int = 25
    displaced_m: float = 0.06
    final_ticks: int = 5
    watches_base: bool = True
    far_up_m: float = 0.06
    shoulder_m: float = 0.3
    delicate_ticks: tuple[int, int] = (10, 5)

    def transit_ticks(self, T_from: np.ndarray, T_to: np.ndarray) -> int:
        """Return the number of ticks in which hands come from some poses (hands, 4, 4) to others."""
        distance = float(norm((T_to - T_from)[:, :3, 3]).max())
        return max(self.min_transit_ticks, int(np.ceil(10.0 * distance / self.transit_speed)))


@dataclass(frozen=True, kw_only=True)
class GripSettings:
    """How a gripper closes: first the hand settles where the demonstrated one was, then the grip is verified.

    Attributes:
        settle_m: Distance from its place beside the object at which a hand is settled.
        settle_ticks: Largest number of ticks to settle; the gripper closes after them in any case.
        gain: Share of the hand's remaining error by which its target moves in each tick.
        max_correction_m: Largest distance by which settling moves a target.
        grip_n: Least normal force of a grip.
        grip_ticks: Largest number of ticks to wait for that force; after them the object was missed.
    """

    settle_m: float = 0.006
    settle_ticks: int = 15
    gain: float = 0.3
    max_correction_m: float = 0.04
    grip_n: float = 2.0
    grip_ticks: int = 15


@dataclass(frozen=True, kw_only=True)
class RetreatSettings:
    """What a robot does between a stage that has failed and the next try.

    Attributes:
        release_ticks: Ticks to open the grippers.
        speed: Speed of the hands on their way back, as a multiple of that on their way to the object.
        rest_ticks: Ticks to let the arms down.
        back_m: Distance that the base steps back once the arms are down.
    """

    release_ticks: int = 5
    speed: int = 2
    rest_ticks: int = 10
    back_m: float = 0.2


@dataclass(frozen=True, kw_only=True)
class AdaptationSettings:
    """What attempts do about worlds that vary; in the plain world, which the demonstration is from, they do none of it.

    Attributes:
        squeeze: Force with which two palms press on the thing between them, as a multiple of the demonstrated one; 0
            repeats the demonstrated motion instead.
        max_squeeze_m: Largest distance by which that moves the target of a palm [m].
        leave_m: Distance from where it stood at which a robot that reaches for something steps back there [m].
        holding_leave_m: The same of a robot that has taken hold: steps shake what it holds.
        drift_gain: Velocity that each second of an error of one metre or radian adds to those steps [m/s and rad/s]: a
            robot that drifts as fast as it steps would never arrive.
        regain_ticks: Largest number of ticks for which the hands' motion waits for those steps, in all.
        highest_m: Largest torso height [m]: with legs as good as straight, a robot that is not quite the modelled one
            keeps stepping where it should stand, and drifts.
        grip_n: Least normal force of a grip [N]; one that barely touches loses its object as it lifts it.
        retries: Most times that an attempt begins again after it has missed its walk's goal, its reach or its grip, has
            pushed an object away, or has made its motion without success; more where ``DataVariation.retries`` is more.
        max_walks: Number of walks to a place before the attempt gives up.
        accept_m: Largest distance from the goal of a walk at which a robot that stands still goes on.
    """

    squeeze: float = 2.0
    max_squeeze_m: float = 0.04
    leave_m: float = 0.09
    holding_leave_m: float = 0.16
    drift_gain: float = 0.6
    regain_ticks: int = 50
    highest_m: float = 0.742
    grip_n: float = 8.0
    retries: int = 2
    max_walks: int = 6
    accept_m: float = 0.08


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How attempts are made; the defaults are those of ``demohlm generate``.

    Attributes:
        variation: How attempts differ from plain ones.
        adaptation: What they do about worlds that vary.
        tables: How they keep clear of tables in worlds that vary, in R4.
        handing_over: How a hand pushes a thing onto the other's palm in worlds that vary, in R4.
        retreat: What a robot does between a stage that has failed and the next try.
        grip: How a gripper closes.
        locomotion: How the robot walks to its place.
        playback: How the hands follow the demonstration.
    """

    variation: DataVariation = field(default_factory=DataVariation)
    adaptation: AdaptationSettings = field(default_factory=AdaptationSettings)
    tables: TableSettings = field(default_factory=TableSettings)
    handing_over: HandingOverSettings = field(default_factory=HandingOverSettings)
    retreat: RetreatSettings = field(default_factory=RetreatSettings)
    grip: GripSettings = field(default_factory=GripSettings)
    locomotion: LocomotionSettings = field(default_factory=LocomotionSettings)
    playback: PlaybackSettings = field(default_factory=PlaybackSettings)

    @property
    def adapts(self) -> bool:
        """Whether the adaptation counts: worlds vary."""
        return self.variation.variation != PLAIN.variation

    @property
    def walking(self) -> LocomotionSettings:
        """How the robot walks to its place here."""
        if not self.adapts:
            return self.locomotion
        return replace(self.locomotion, max_walks=self.adaptation.max_walks, accept_m=self.adaptation.accept_m)

    @property
    def gripping(self) -> GripSettings:
        """How a gripper closes here."""
        return replace(self.grip, grip_n=self.adaptation.grip_n) if self.adapts else self.grip

    @property
    def ik(self) -> IKSettings:
        """How hands are brought to their targets here."""
        return IKSettings(highest=self.adaptation.highest_m) if self.adapts else IKSettings()

    @property
    def retries(self) -> int:
        """Most times that an attempt begins again here."""
        return max(self.variation.retries, self.adaptation.retries if self.adapts else 0)


class StageError(Exception):
    """A stage that cannot go on.

    Args:
        outcome: One of the outcomes of an attempt.
        reason: The same in words, with the numbers that it was judged by.
        again: Whether nothing has been taken hold of yet, so that it may be tried again from where things are.
    """

    def __init__(self, outcome: str, reason: str, again: bool = False) -> None:
        super().__init__(outcome, reason, again)
        self.outcome, self.reason, self.again = outcome, reason, again


def first_approach(segments: Sequence[Segment]) -> Segment:
    """Return the segment that leads a hand to the first object: it decides from where to act."""
    return min((entry for entry in segments if entry.kind == "object"), key=lambda entry: entry.start)


def choose_placement(
    world: WorldView, task: Task, demonstration: Demonstration, segments: Sequence[Segment]
) -> retarget.Placement:
    """Choose from where to act on the first object that a hand goes to."""
    first = first_approach(segments)
    assert first.object is not None  # object segments have one
    index = [entry.name for entry in task.objects].index(first.object)
    T_W_Od, T_W_Rd = demonstration.T_world_objects[first.start, index], demonstration.T_world_pelvis[0]
    others = [
        (demonstration.T_world_objects[first.start, column], world.pose(entry.name))
        for column, entry in enumerate(task.objects)
        if column != index
    ]
    distance = float(norm(T_W_Od[:2, 3] - T_W_Rd[:2, 3]))
    return retarget.choose_placement(
        task.object(first.object).symmetry,
        T_W_Rd=T_W_Rd,
        T_W_Od=T_W_Od,
        T_W_O=world.pose(first.object),
        T_W_R=world.pose("pelvis"),
        clearance_m=0.9 * distance,
        others=others,
    )


def clear_stance(
    goal: np.ndarray, world: WorldView, task: Task, demonstration: Demonstration, segments: Sequence[Segment]
) -> np.ndarray:
    """Return a base goal (3,) that is as far from the table under the first object as the demonstrated one was."""
    tables = tables_under(world, task, demonstration, first_approach(segments))
    if tables is None:
        return goal
    then, now = (table.T_world_table[:2, 3] for table in tables)
    distance = float(norm(then - demonstration.T_world_pelvis[0, :2, 3])) - TOLERANCE_M
    return stand_clear(goal, now, distance)


def stance(seed: int, index: int, spread: float) -> np.ndarray:
    """Return how far (x, y, yaw) [m, m, rad] the goal of attempt ``index`` of run ``seed`` is off, in its own frame.

    A policy stops a little off the place that suits it best, and is to know what the hands do from there.
    """
    low, high = spread * STANCE_RANGES.T
    return np.random.default_rng([STANCE_STREAM, seed, index]).uniform(low, high)


def locomotion(world: WorldView, goal: np.ndarray, settings: LocomotionSettings) -> Iterator[np.ndarray]:
    """Walk until the base stands at its goal (x, y, yaw); fails with "off_course" where it does not get there."""
    try:
        yield from walk(lambda: world.pose("pelvis"), goal, settings)
    except OffCourseError:
        here = poses.to_planar(world.pose("pelvis"))
        distance, turn = norm((goal - here)[:2]), abs(np.degrees(poses.wrap_angle(goal[2] - here[2])))
        raise StageError(
            "off_course",
            f"the base stood {distance:.3f} m and {turn:.0f} deg from its goal after all its walks (it goes on within "
            f"{settings.accept_m:g} m and {np.degrees(settings.accept_rad):.0f} deg)",
            again=True,
        ) from None


def go_around(world: WorldView, task: Task, goal: np.ndarray, settings: LocomotionSettings) -> Iterator[np.ndarray]:
    """Walk to where a way around the first support bends, if the straight one to (x, y, yaw) leads through it."""
    if not task.supports:
        return
    centre, here = world.pose(task.supports[0])[:2, 3], world.pose("pelvis")[:2, 3]
    distance = float(norm(goal[:2] - centre))
    clear = distance + PASSING_M
    before_it = centre + clear / distance * (goal[:2] - centre)  # from there it steps in
    bend = way_around(here, before_it, centre, clear)
    if bend is None:
        return
    passing = replace(settings, max_walks=1, tolerance_m=0.15, tolerance_rad=0.6, settle_ticks=0, straight=True)
    with contextlib.suppress(OffCourseError):  # from near it, the way on is clear too
        yield from walk(lambda: world.pose("pelvis"), np.append(bend, goal[2]), passing)


def step_back(world: WorldView, settings: RetreatSettings) -> Iterator[np.ndarray]:
    """Let the arms down and step back, for another try; how far exactly does not matter."""
    last, rest = world.command(), command.rest()
    for share in np.arange(1, settings.rest_ticks + 1) / settings.rest_ticks:
        yield (1.0 - share) * last + share * rest
    behind = poses.planar(*poses.to_planar(world.pose("pelvis"))) @ poses.planar(-settings.back_m, 0.0, 0.0)
    with contextlib.suppress(OffCourseError):
        yield from walk(lambda: world.pose("pelvis"), poses.to_planar(behind), LocomotionSettings(max_walks=1))
