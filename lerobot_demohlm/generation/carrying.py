"""What hands hold and where it is to go -> the walk there with it, and the hand targets that set it down there.

The motion of the last part is about the goal: what is held repeats its demonstrated way relative to the goal, and the
hands keep the grip that they have on it now, which need not be the demonstrated one.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import locomotion, retarget
from lerobot_demohlm.generation.clearance import way_around
from lerobot_demohlm.generation.locomotion import LocomotionSettings, OffCourseError
from lerobot_demohlm.generation.stages import StageError
from lerobot_demohlm.generation.world_view import WorldView

MAX_VELOCITY = (0.35, 0.2, 0.2, 0.4)  # m/s, m/s, m/s, rad/s: forward, backward, sideways and turning with a load
MAX_TICKS = 350
BACK_M = 0.35  # that the robot steps back before it turns to the goal
_BEND_COST = 2.0  # m, rather than which the robot turns: on its way past a table it may brush against it
_PASSING = {"max_walks": 1, "tolerance_m": 0.10, "tolerance_rad": 0.6, "settle_ticks": 0}  # where a way bends
_SETTLED = 10  # ticks after the last step of a demonstrated walk, at which the robot stands


class Carrying:
    """The parts of a demonstration in which something is brought to its goal.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        segments: Its segments.
        settings: How the robot walks without a load.

    Attributes:
        resumes: Tick with which the demonstration goes on after the last walk of its own; 0 before one.
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        settings: LocomotionSettings,
    ) -> None:
        self.resumes = 0
        self._world, self._task, self._demonstration = world, task, demonstration
        self._settings = replace(settings, max_velocity=MAX_VELOCITY, max_ticks=MAX_TICKS, straight=True)
        self._names = [entry.name for entry in task.objects]
        self._goals = [entry for entry in segments if entry.held is not None]
        goal_starts = {entry.start: entry for entry in self._goals}
        self._walks = {
            entry.start: goal_starts[entry.stop]
            for entry in segments
            if entry.anchor == "base" and entry.kind == "proprioception" and entry.stop in goal_starts
        }
        self._turns: dict[int, np.ndarray] = {}  # of the goal, by the tick at which a segment about it starts
        self._ways: dict[int, np.ndarray] = {}  # (T, 4, 4) of what a hand holds, from the start of its segment on

    def begins(self, tick: int) -> bool:
        """Tell whether a walk with a load begins here."""
        return tick in self._walks

    def walk(self, tick: int) -> Iterator[np.ndarray]:
        """Yield velocities (3,) [m/s, m/s, rad/s] that take the base back, and then to where it stood for the goal.

        It goes around both the place where the thing was taken and the goal.

        Raises:
            StageError: It does not get there.
        """
        entry = self._walks[tick]
        behind = poses.planar(*poses.to_planar(self._world.pose("pelvis"))) @ poses.planar(-BACK_M, 0.0, 0.0)
        with contextlib.suppress(OffCourseError):  # away from what it took the thing from; how far exactly is no matter
            yield from self._velocities(poses.to_planar(behind), replace(self._settings, max_walks=1))
        T_W_Od, T_W_O = self._goal_poses(entry)
        goal = self._task.goals[str(entry.held)]
        T_W_Rd = self._demonstration.T_world_pelvis[min(entry.start + _SETTLED, entry.stop - 1)]
        clearance = float(norm((T_W_Od - T_W_Rd)[:2, 3]))  # as the robot stands at the goal, so it may pass
        placement = retarget.choose_placement(
            "any" if goal.any_yaw else self._task.object(goal.object).symmetry,
            T_W_Rd=T_W_Rd,
            T_W_Od=T_W_Od,
            T_W_O=T_W_O,
            T_W_R=self._world.pose("pelvis"),
            clearance_m=clearance,
            bend_cost=_BEND_COST,
        )
        self._turns[entry.start] = placement.symmetry
        for obstacle in (self._world.start_pose(str(entry.held)), T_W_O):
            here = self._world.pose("pelvis")[:2, 3]
            bend = way_around(here, placement.goal[:2], obstacle[:2, 3], clearance)
            if bend is not None:
                with contextlib.suppress(OffCourseError):
                    yield from self._velocities(np.append(bend, placement.goal[2]), replace(self._settings, **_PASSING))
        try:
            yield from self._velocities(placement.goal, self._settings)
        except OffCourseError:
            left = float(norm((placement.goal - poses.to_planar(self._world.pose("pelvis")))[:2]))
            reason = f"the base stood {left:.3f} m from its place at the {goal.object} after all its walks with a load"
            raise StageError("off_course", reason) from None
        self.resumes = entry.start

    def _velocities(self, goal: np.ndarray, settings: LocomotionSettings) -> Iterator[np.ndarray]:
        """Yield the velocities of a walk to a goal (3,) x, y, yaw [m, m, rad]."""
        for wanted in locomotion.walk(lambda: self._world.pose("pelvis"), goal, settings):
            yield wanted[command.VELOCITY]

    def targets(
        self, group: tuple[Segment, ...], last: np.ndarray, symmetries: Mapping[str | None, np.ndarray]
    ) -> np.ndarray:
        """Return the targets (T, hands, 4, 4) of hands that begin to bring something to its goal.

        ``E[t] = M X_d[t] C inv(X_d[t]) E_d[t]``: M moves the demonstrated goal to this one, X is what is held, and C
        how the hands hold it now relative to how they held it then.

        Args:
            group: Their segments.
            last: (hands, 4, 4) their last targets.
            symmetries: Turn (4, 4) of each object after which it lies as the demonstrated one did.
        """
        first = group[0]
        ticks = slice(first.start, max(entry.stop for entry in group))
        hands = [g1.SIDES.index(entry.hand) for entry in group]
        T_W_Od, T_W_O = self._goal_poses(first)
        motion = retarget.scene_motion(T_W_Od, T_W_O, self._turn(first, T_W_Od, T_W_O))
        held_d = self._demonstration.T_world_objects[ticks, self._names.index(str(first.held))]
        T_W_X = self._world.pose(str(first.held)) @ symmetries.get(first.held, np.eye(4))
        demonstrated = self._demonstration.T_world_targets[ticks][:, hands]
        before = self._demonstration.T_world_targets[max(first.start - 1, 0)][hands]
        grip = (poses.invert(T_W_X) @ last) @ poses.invert(poses.invert(held_d[0]) @ before)
        way = motion @ held_d
        for hand in hands:
            self._ways[hand] = way
        return way[:, None] @ grip @ (poses.invert(held_d)[:, None] @ demonstrated)

    def hands(self, tick: int) -> list[int]:
        """Return which hands bring something to its goal."""
        return [g1.SIDES.index(entry.hand) for entry in self._goals if entry.start <= tick < entry.stop]

    def misses(self, tick: int, detours: np.ndarray) -> dict[int, np.ndarray]:
        """Return how far (3,) what hands hold is off its way [m], by hand, until they let go.

        Args:
            tick: Of the demonstration.
            detours: (2, 3) by which hands are meant to be off it [m].
        """
        found = {}
        for entry in self._goals:
            hand = g1.SIDES.index(entry.hand)
            if entry.start <= tick < entry.stop and self._holds(entry, tick):
                wanted = self._ways[hand][tick - entry.start, :3, 3] + detours[hand]
                found[hand] = wanted - self._world.pose(str(entry.held))[:3, 3]
        return found

    def _holds(self, entry: Segment, tick: int) -> bool:
        """Tell whether the hand still held its thing in the demonstration."""
        column = self._task.contact_pairs.index((entry.hand, str(entry.held)))
        return bool(self._demonstration.contact_forces[tick, column] >= CONTACT_FORCE_N)

    def _goal_poses(self, entry: Segment) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose (4, 4) of a segment's goal then and now."""
        then = self._demonstration.T_world_objects[entry.start, self._names.index(str(entry.object))]
        return then, self._world.pose(str(entry.object))

    def _turn(self, entry: Segment, T_W_Od: np.ndarray, T_W_O: np.ndarray) -> np.ndarray:
        """Return the turn (4, 4) of the goal: chosen for the walk there, or that which suits how the robot stands."""
        if entry.start in self._turns:
            return self._turns[entry.start]
        goal = self._task.goals[str(entry.held)]
        T_W_Rd, T_W_R = self._demonstration.T_world_pelvis[entry.start], self._world.pose("pelvis")
        turned = float(poses.yaw(T_W_R) - poses.yaw(T_W_Rd))
        free = float(poses.wrap_angle(turned - poses.yaw(T_W_O) + poses.yaw(T_W_Od)))
        symmetry = self._task.object(goal.object).symmetry
        if goal.any_yaw or symmetry == "any":
            return poses.planar(0.0, 0.0, free)
        return poses.planar(0.0, 0.0, min(symmetry, key=lambda angle: abs(float(poses.wrap_angle(free - angle)))))
