"""A demonstration and one world -> where the palms are to be, tick by tick, filled in as parts of the motion begin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.carrying import Carrying
from lerobot_demohlm.generation.handing_over import HandingOver
from lerobot_demohlm.generation.shoulders import before_shoulder
from lerobot_demohlm.generation.stages import PlaybackSettings, first_approach
from lerobot_demohlm.generation.tables import kept_above
from lerobot_demohlm.generation.world_view import WorldView

NO_HIGHER_M = 0.005  # above the demonstrated height, up to which a thing began there


@dataclass(frozen=True, kw_only=True)
class Started:
    """Segments that have begun together, and between which frames their motion is carried over.

    Attributes:
        group: The segments.
        frames_then: (hands, 4, 4) in the demonstration: the object, or the anchors.
        frames_now: (hands, 4, 4) here: the object with its symmetry applied, or the anchors.
    """

    group: tuple[Segment, ...]
    frames_then: np.ndarray
    frames_now: np.ndarray


class HandTargets:
    """Where the palms are to be.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        segments: Its segments.
        symmetry: (4, 4) the chosen symmetry of the first object.
        carrying: Says where hands go that bring something to its goal.
        settings: Limits and times.
        over_m: Height [m] that hands which reach out at once keep until their way is as high; None where they need not.
        handing_over: How hands keep to the way of a thing that one pushes onto the other; None where none does.

    Attributes:
        last: (2, 4, 4) the targets of the last command; at first, where the palms are.
        started: Segments that have begun, in the order of time.
        motions: (4, 4) of each hand that follows an object: from the demonstrated scene to this one.
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        symmetry: np.ndarray,
        carrying: Carrying,
        settings: PlaybackSettings,
        over_m: float | None = None,
        handing_over: HandingOver | None = None,
    ) -> None:
        self._world, self._task, self._demonstration, self._settings = world, task, demonstration, settings
        self.last = world.hands()
        self.started: list[Started] = []
        self.motions: dict[int, np.ndarray] = {}
        self._names = [entry.name for entry in task.objects]
        self._symmetries = {first_approach(segments).object: symmetry}
        self._tracks = {hand: [entry for entry in segments if entry.hand == hand] for hand in g1.SIDES}
        self._targets = np.tile(np.eye(4), (len(demonstration), len(g1.SIDES), 1, 1))
        self._shift = np.zeros((len(g1.SIDES), 3))  # m, by which their targets are moved so that they get there
        self._detours = np.zeros((len(demonstration), len(g1.SIDES), 3))  # m, that hands are off it as they join it
        self._held_on_base = np.tile(np.eye(4), (len(g1.SIDES), 1, 1))  # last target over what follows the base
        self._since = np.eye(4)  # from the demonstrated floor plane to this one, frozen when a part begins
        self._carrying, self._over_m, self._handing_over = carrying, over_m, handing_over

    def at(self, tick: int) -> np.ndarray:
        """Return the targets (2, 4, 4) of a tick."""
        return self._targets[tick]

    def begin(self, tick: int, starting: Sequence[tuple[Segment, ...]]) -> None:
        """Fill in the targets of the groups of segments that begin at a tick."""
        if starting:
            self._since = _floor(self._world.pose("pelvis")) @ poses.invert(self.base_then(tick))
        for group in starting:
            self._start(group)

    def join(self, tick: int, starting: Sequence[Segment]) -> int:
        """Lead hands onto the motion that begins, as it goes on.

        Returns:
            0, or the number of ticks that their way takes where they would come to an object too soon: they are to make
            it before the motion.
        """
        entries = [entry for entry in starting if entry.kind == "object" or entry.anchor != "base"]
        if not entries:
            return 0  # hands that follow the base are led there tick by tick
        hands = [g1.SIDES.index(entry.hand) for entry in entries]
        last, path = self.last[hands], self._targets[tick:, hands]
        ticks = self._settings.transit_ticks(last, path[0])
        room = int(self._settings.joining_share * min(entry.stop - tick for entry in entries))
        if ticks > room:
            return ticks
        joined = retarget.join(last, path[:room])
        self._detours[tick : tick + room, hands] = (joined - path[:room])[..., :3, 3]
        self._targets[tick : tick + room, hands] = joined
        return 0

    def follow_base(self, tick: int) -> None:
        """Fill in the targets of hands that follow the base as it walks."""
        for hand, side in enumerate(g1.SIDES):
            here = self._segment(side, tick)
            if here.anchor == "base" and here.kind == "proprioception":
                demonstrated = self._demonstration.T_world_targets[tick, hand]
                T_W_Rd, T_W_R = self._demonstration.T_world_pelvis[tick], self.pelvis(tick)
                carried = retarget.carried_targets(demonstrated, T_W_Rd, T_W_R)
                self._targets[tick, hand] = carried @ self._held_on_base[hand]

    def steer(self, tick: int) -> None:
        """Move the targets of hands that follow an object by what they measurably miss: arms sag as they are held."""
        measured = self._world.hands()
        for hand, missed in self._carrying.misses(tick, self._detours[tick]).items():
            self._shift_more(hand, missed)
        for hand, motion in self.motions.items():
            wanted = (motion @ self._demonstration.T_world_hands[tick, hand])[:3, 3] + self._detours[tick, hand]
            if self._handing_over is not None and hand == self._handing_over.taker:
                beside = self._handing_over.beside(tick)
                wanted, self._targets[tick, hand, :3, 3] = wanted + beside, self._targets[tick, hand, :3, 3] + beside
            self._shift_more(hand, wanted - measured[hand, :3, 3])
        for hand in {*self._carrying.hands(tick), *self.motions}:
            self._targets[tick, hand, :3, 3] += self._shift[hand]
        if self._handing_over is not None:
            self._targets[tick, self._handing_over.giver, :3, 3] += self._handing_over.held_back(tick)

    def object_motion(self, name: str, tick: int) -> np.ndarray:
        """Return the motion (4, 4) of an object from where it was at a tick of the demonstration to where it is."""
        T_W_Od, T_W_O = self._demonstration.T_world_objects[tick, self._names.index(name)], self._world.pose(name)
        return retarget.scene_motion(T_W_Od, T_W_O, self._symmetry(name, T_W_Od, T_W_O, tick))

    def is_close(self, tick: int, hand: int) -> bool:
        """Return whether a hand that follows an object is close to where its approach ends."""
        last = self._segment(g1.SIDES[hand], tick).stop - 1
        left = self._targets[last, hand, :3, 3] - self._targets[tick, hand, :3, 3]
        return float(norm(left)) < self._settings.close_m

    def pelvis(self, tick: int) -> np.ndarray:
        """Return the pose (4, 4) from which commands of a tick are found; its height and tilt are always measured."""
        measured = self._world.pose("pelvis")
        if self._settings.watches_base:
            return measured
        return self._since @ self.base_then(tick) @ poses.invert(_floor(measured)) @ measured

    def base_then(self, tick: int) -> np.ndarray:
        """Return the demonstrated base (4, 4) on the floor plane."""
        return _floor(self._demonstration.T_world_pelvis[tick])

    def _start(self, group: tuple[Segment, ...]) -> None:
        """Fill in the targets of segments that begin together."""
        hands = [g1.SIDES.index(entry.hand) for entry in group]
        first = group[0]
        ticks = slice(first.start, max(entry.stop for entry in group))
        demonstrated = self._demonstration.T_world_targets[ticks][:, hands]
        if first.held is not None:
            targets = self._carrying.targets(group, self.last[hands], self._symmetries)
            for hand in hands:
                self.motions.pop(hand, None)
            self._shift[hands] = 0.0
        elif first.kind == "object":
            assert first.object is not None  # object segments have one
            T_W_Od = self._demonstration.T_world_objects[first.start, self._names.index(first.object)]
            T_W_O = self._world.pose(first.object)
            symmetry = self._symmetry(first.object, T_W_Od, T_W_O, first.start)
            targets = retarget.object_targets(demonstrated, T_W_Od, T_W_O, symmetry)
            self._note(group, T_W_Od, T_W_O @ symmetry)
            motion = retarget.scene_motion(T_W_Od, T_W_O, symmetry)
            self.motions |= dict.fromkeys(hands, motion)
            if self._handing_over is not None and self._handing_over.taker in hands:
                self._handing_over.begin(motion)
            self._shift[hands] = 0.0
        else:
            for hand in hands:
                self.motions.pop(hand, None)
            before = max(first.start - 1, 0)
            last_d = self._demonstration.T_world_targets[before][hands]
            T_W_Rd, T_W_R = self._demonstration.T_world_pelvis[first.start], self._world.pose("pelvis")
            if first.anchor == "base":
                carried = retarget.carried_targets(last_d, T_W_Rd, T_W_R)
                self._held_on_base[hands] = poses.invert(carried) @ self.last[hands]
                self._note(group, T_W_Rd, T_W_R)
                return  # these targets are found tick by tick
            if first.start == 0:  # a hand that follows the robot from the beginning keeps its place on it
                last = retarget.object_targets(last_d, poses.heading(T_W_Rd), poses.heading(T_W_R), np.eye(4))
            else:
                last = self.last[hands]
            if first.anchor == "body":
                way = np.concatenate([last_d[None], demonstrated])
                path = retarget.carried_targets(way, T_W_Rd, T_W_R)
                path[..., 2, 3] += self._raised(first.object)
                targets = retarget.bring(last, path, retarget.progress(way))[1:]
                self._note(group, T_W_Rd, T_W_R)
            else:
                anchors_d = retarget.anchor_pose(first.anchor, last_d, T_W_Rd)
                anchors = retarget.anchor_pose(first.anchor, last, T_W_R)
                targets = retarget.anchored_targets(demonstrated, last_d, last, anchors_d, anchors)
                self._note(group, anchors_d, anchors)
        for column, (hand, entry) in enumerate(zip(hands, group, strict=True)):
            path = targets[: entry.stop - entry.start, column]
            if entry.kind == "object" and entry.start == 0 and self._over_m is not None:
                path = kept_above(path, self._over_m)
            if entry.kind == "object" and self._is_far_up(entry.object):
                ahead = poses.heading(self._world.pose("pelvis"))[:3, 0]
                p_shoulder = self._world.pose(f"{entry.hand}_shoulder_roll_link")[:3, 3]
                path = before_shoulder(path, p_shoulder, ahead, self._settings.shoulder_m)
            self._targets[entry.start : entry.stop, hand] = path

    def _note(self, group: tuple[Segment, ...], then: np.ndarray, now: np.ndarray) -> None:
        shape = (len(group), 4, 4)
        frames_then, frames_now = (np.broadcast_to(frame, shape).copy() for frame in (then, now))
        self.started.append(Started(group=group, frames_then=frames_then, frames_now=frames_now))

    def _raised(self, name: str | None) -> float:
        """Return how much higher a thing began than in the demonstration [m]: so much higher it is taken, too.

        A lift that ended at the demonstrated height would be too short. From lower down it ends there nonetheless, as
        the robot cannot carry things at its knees. Differences below 5 mm are none: things settle.
        """
        if name is None:
            return 0.0
        began = self._demonstration.T_world_objects[0, self._names.index(name), 2, 3]
        higher = float(self._world.start_pose(name)[2, 3] - began)
        return higher if higher > NO_HIGHER_M else 0.0

    def _is_far_up(self, name: str | None) -> bool:
        """Return whether a thing that is on no table began so much higher than demonstrated that arms lack room."""
        return not self._task.supports and self._raised(name) > self._settings.far_up_m

    def _symmetry(self, name: str, T_W_Od: np.ndarray, T_W_O: np.ndarray, tick: int) -> np.ndarray:
        if name not in self._symmetries:
            self._symmetries[name] = retarget.choose_placement(
                self._task.object(name).symmetry,
                T_W_Rd=self._demonstration.T_world_pelvis[tick],
                T_W_Od=T_W_Od,
                T_W_O=T_W_O,
                T_W_R=self._world.pose("pelvis"),
            ).symmetry
        return self._symmetries[name]

    def _shift_more(self, hand: int, missed: np.ndarray) -> None:
        shift = self._shift[hand] + self._settings.steering_gain * missed
        self._shift[hand] = shift * min(1.0, self._settings.max_shift_m / max(float(norm(shift)), 1e-9))

    def _segment(self, side: str, tick: int) -> Segment:
        """Return what a hand is at, at a tick; its segments cover the demonstration."""
        return next(entry for entry in self._tracks[side] if entry.start <= tick < entry.stop)


def _floor(T_world_pelvis: np.ndarray) -> np.ndarray:
    return poses.planar(*poses.to_planar(T_world_pelvis))
