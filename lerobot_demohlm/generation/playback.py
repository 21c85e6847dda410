"""A demonstration and one world -> the commands of pre-manipulation and manipulation, by inverse kinematics."""

from collections.abc import Iterator, Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstration import Demonstration
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.stages import MANIPULATION, PRE_MANIPULATION, PlaybackSettings, StageError
from lerobot_demohlm.generation.world import World
from lerobot_demohlm.segmentation import Segment, groups


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
