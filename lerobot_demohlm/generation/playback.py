"""A demonstration and one world -> the commands of pre-manipulation and manipulation, by inverse kinematics."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import groups
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import retarget
from lerobot_demohlm.generation.base_path import BasePath
from lerobot_demohlm.generation.carrying import Carrying
from lerobot_demohlm.generation.gripping import Gripping
from lerobot_demohlm.generation.squeeze import Squeeze
from lerobot_demohlm.generation.stages import (
    MANIPULATION,
    PRE_MANIPULATION,
    RetreatSettings,
    Settings,
    StageError,
    first_approach,
)
from lerobot_demohlm.generation.stance import Stance
from lerobot_demohlm.generation.world_view import WorldView

_UPRIGHT = 0.98  # cosine of the tilt up to which a thing stands as it did
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
        tick: Of the demonstration, which the last command was for.
        activity: What that command did: "follow" the demonstration, "transit" to where a part of it begins, "wait" for
            the torso, "regain" the stance, "settle" a gripper, "grip" an object, "walk on", "hold" still at the end, or
            "withdraw" after a failure.
        last_targets: (2, 4, 4) poses of the palms that it aimed at.
        error: (2,) what inverse kinematics left of the way to them [m].
        started: Segments that have begun, in the order of time.
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        symmetry: np.ndarray,
        settings: Settings,
    ) -> None:
        self.world, self.task, self.demonstration = world, task, demonstration
        self.settings = settings.playback
        self.stage, self.tick, self.activity = PRE_MANIPULATION, 0, "transit"
        self.started: list[Started] = []
        self._names = [entry.name for entry in task.objects]
        self._groups = groups(segments)
        self._symmetries = {first_approach(segments).object: symmetry}
        self._tracks = {hand: [entry for entry in segments if entry.hand == hand] for hand in g1.SIDES}
        self._targets = np.tile(np.eye(4), (len(demonstration), len(g1.SIDES), 1, 1))
        self.last_targets = world.hands()  # where the hands are stands in for the first commanded target
        self.error, self._trailing = np.zeros(len(g1.SIDES)), 0
        self._unmended = np.zeros(len(g1.SIDES))  # m, errors that no waiting for the torso has mended
        self._way = [self.last_targets]  # of the hands so far
        self._motions: dict[int, np.ndarray] = {}  # of hands that follow an object: from the demonstrated scene to this
        self._shift = np.zeros((len(g1.SIDES), 3))  # m, by which their targets are moved so that they get there
        self._detours = np.zeros((len(demonstration), len(g1.SIDES), 3))  # m, that hands are off it as they join it
        self._held_on_base = np.tile(np.eye(4), (len(g1.SIDES), 1, 1))  # last target over what follows the base
        self._since = np.eye(4)  # from the demonstrated floor plane to this one, frozen when a part begins
        self._base_path = BasePath(demonstration, self.settings)
        self._carrying = Carrying(world, task, demonstration, segments, settings.walking)
        share = settings.adaptation.squeeze if settings.adapts else 0.0
        self._squeeze = Squeeze(world, task, demonstration, share, settings.adaptation.max_squeeze_m)
        self._adapts, self._adaptation = settings.adapts, settings.adaptation
        self._places = {name: world.pose(name) if self._adapts else world.start_pose(name) for name in self._names}
        self._regain_ticks = settings.adaptation.regain_ticks  # that are left
        self._stance = Stance(settings.locomotion.window_ticks)
        self._gripping = Gripping(world, task, demonstration, segments, settings.gripping)
        self._switches = {entry.start for entry in segments if entry.start > 0} | self._gripping.switches

    def run(self) -> Iterator[np.ndarray]:
        """Yield commands until the demonstration is over."""
        for tick in range(len(self.demonstration)):
            if tick < self._carrying.resumes:
                continue  # the robot has walked to the goal in its own way
            closes = bool(self._gripping.closing(tick))
            if closes:
                yield from self._settle(tick)
            starting = [group for group in self._groups if group[0].start == tick]
            if starting:
                self._since = self._floor(self.world.pose("pelvis")) @ poses.invert(self._floor_d(tick))
            for group in starting:
                self._start(group)
            if any(entry.kind == "object" for group in starting for entry in group) or tick == 0:
                yield from self._join(tick, [entry for group in starting for entry in group])
            if self.stage == PRE_MANIPULATION and self._touching(tick):
                self._check_reached()
                self.stage = MANIPULATION
            self._follow_base(tick)
            if self._carrying.begins(tick):
                yield from self._carry(tick)
                continue
            yield from self._regain(tick)
            self._steer(tick)
            self.activity = "follow"
            velocity = self._base_path.velocity(tick, self._pelvis(tick))
            yield self._command(self._targets[tick], tick, velocity)
            if not velocity.any():
                yield from self._await_torso(tick)
            if self._base_path.ends(tick):
                yield from self._walk_on(tick)
            if closes:
                yield from self._verify_grip(tick)
        last = self.world.command()
        self.activity = "hold"
        for _ in range(self.settings.final_ticks):
            yield last

    @property
    def delicate(self) -> bool:
        """Whether the last command has to do with a touch, a grip or a release, and is to be executed as planned."""
        before, after = self.settings.delicate_ticks
        near = any(-before <= self.tick - switch <= after for switch in self._switches)
        return near or self.activity not in ("transit", "follow", "walk on")

    def withdraw(self, settings: RetreatSettings) -> Iterator[np.ndarray]:
        """Yield commands that open the grippers and take the hands back the way they came."""
        self.stage, self.activity = PRE_MANIPULATION, "withdraw"
        back = self._way[::-1]
        for targets in [*back[:1] * settings.release_ticks, *back[:: settings.speed], back[-1]]:
            yield self._command(targets, 0)

    def _start(self, group: tuple[Segment, ...]) -> None:
        """Fill in the targets of segments that begin together."""
        hands = [g1.SIDES.index(entry.hand) for entry in group]
        first = group[0]
        ticks = slice(first.start, max(entry.stop for entry in group))
        demonstrated = self.demonstration.T_world_targets[ticks][:, hands]
        if first.held is not None:
            targets = self._carrying.targets(group, self.last_targets[hands], self._symmetries)
            for hand in hands:
                self._motions.pop(hand, None)
            self._shift[hands] = 0.0
        elif first.kind == "object":
            assert first.object is not None  # object segments have one
            T_W_Od = self.demonstration.T_world_objects[first.start, self._names.index(first.object)]
            T_W_O = self.world.pose(first.object)
            symmetry = self._symmetry(first.object, T_W_Od, T_W_O, first.start)
            targets = retarget.object_targets(demonstrated, T_W_Od, T_W_O, symmetry)
            self._note(group, T_W_Od, T_W_O @ symmetry)
            motion = retarget.scene_motion(T_W_Od, T_W_O, symmetry)
            self._motions |= dict.fromkeys(hands, motion)
            self._shift[hands] = 0.0
        else:
            for hand in hands:
                self._motions.pop(hand, None)
            before = max(first.start - 1, 0)
            last_d = self.demonstration.T_world_targets[before][hands]
            T_W_Rd, T_W_R = self.demonstration.T_world_pelvis[first.start], self.world.pose("pelvis")
            if first.anchor == "base":
                carried = retarget.carried_targets(last_d, T_W_Rd, T_W_R)
                self._held_on_base[hands] = poses.invert(carried) @ self.last_targets[hands]
                self._note(group, T_W_Rd, T_W_R)
                return  # these targets are found tick by tick
            if first.start == 0:  # a hand that follows the robot from the beginning keeps its place on it
                last = retarget.object_targets(last_d, poses.heading(T_W_Rd), poses.heading(T_W_R), np.eye(4))
            else:
                last = self.last_targets[hands]
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
            self._targets[entry.start : entry.stop, hand] = targets[: entry.stop - entry.start, column]

    def _pelvis(self, tick: int) -> np.ndarray:
        """Return the pose (4, 4) from which commands of a tick are found; its height and tilt are always measured."""
        measured = self.world.pose("pelvis")
        if self.settings.watches_base:
            return measured
        return self._since @ self._floor_d(tick) @ poses.invert(self._floor(measured)) @ measured

    def _floor_d(self, tick: int) -> np.ndarray:
        """Return the demonstrated base (4, 4) on the floor plane."""
        return self._floor(self.demonstration.T_world_pelvis[tick])

    @staticmethod
    def _floor(T_world_pelvis: np.ndarray) -> np.ndarray:
        return poses.planar(*poses.to_planar(T_world_pelvis))

    def _raised(self, name: str | None) -> float:
        """Return how much higher a thing began than in the demonstration [m]: so much higher it is taken, too.

        A lift that ended at the demonstrated height would be too short. From lower down it ends there nonetheless, as
        the robot cannot carry things at its knees. Differences below 5 mm are none: things settle.
        """
        if name is None:
            return 0.0
        began = self.demonstration.T_world_objects[0, self._names.index(name), 2, 3]
        higher = float(self.world.start_pose(name)[2, 3] - began)
        return higher if higher > NO_HIGHER_M else 0.0

    def _note(self, group: tuple[Segment, ...], then: np.ndarray, now: np.ndarray) -> None:
        shape = (len(group), 4, 4)
        frames_then, frames_now = (np.broadcast_to(frame, shape).copy() for frame in (then, now))
        self.started.append(Started(group=group, frames_then=frames_then, frames_now=frames_now))

    def _steer(self, tick: int) -> None:
        """Move the targets of hands that follow an object by what they measurably miss: arms sag as they are held."""
        measured = self.world.hands()
        for hand, missed in self._carrying.misses(tick, self._detours[tick]).items():
            shift = self._shift[hand] + self.settings.steering_gain * missed
            self._shift[hand] = shift * min(1.0, self.settings.max_shift_m / max(float(norm(shift)), 1e-9))
        for hand in self._carrying.hands(tick):
            self._targets[tick, hand, :3, 3] += self._shift[hand]
        for hand, motion in self._motions.items():
            wanted = (motion @ self.demonstration.T_world_hands[tick, hand])[:3, 3] + self._detours[tick, hand]
            missed = wanted - measured[hand, :3, 3]
            shift = self._shift[hand] + self.settings.steering_gain * missed
            self._shift[hand] = shift * min(1.0, self.settings.max_shift_m / max(float(norm(shift)), 1e-9))
            self._targets[tick, hand, :3, 3] += self._shift[hand]

    def _follow_base(self, tick: int) -> None:
        """Fill in the targets of hands that follow the base as it walks."""
        for hand, side in enumerate(g1.SIDES):
            here = self._segment(side, tick)
            if here.anchor == "base" and here.kind == "proprioception":
                demonstrated = self.demonstration.T_world_targets[tick, hand]
                T_W_Rd, T_W_R = self.demonstration.T_world_pelvis[tick], self._pelvis(tick)
                carried = retarget.carried_targets(demonstrated, T_W_Rd, T_W_R)
                self._targets[tick, hand] = carried @ self._held_on_base[hand]

    def _carry(self, tick: int) -> Iterator[np.ndarray]:
        """Walk to the goal of what the hands hold, which stay where they are on the robot."""
        self.activity = "walk on"
        for velocity in self._carrying.walk(tick):
            self._follow_base(tick)
            yield self._command(self._targets[tick], tick, velocity)
        self._stance.leave()  # it stands for another part of the demonstration now

    def _await_torso(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until the torso has bent so far that hands close to their objects are where they should be by now.

        A torso bends slowly. Hands that went on would come down on an object from aside. What remains when the torso
        has come to rest is not waited for again.
        """
        hands = [hand for hand in self._motions if self._is_close(tick, hand)]

        def left() -> float:
            return float((self.error - self._unmended)[hands].max(initial=0.0))

        least, patience = left(), self.settings.patience_ticks
        while least > self.settings.torso_error_m and patience > 0:
            self.activity = "wait"
            yield self._command(self._targets[tick], tick)
            error = left()
            patience = self.settings.patience_ticks if error < least - self.settings.torso_gain_m else patience - 1
            least = min(least, error)
        if patience == 0:
            self._unmended[hands] = np.maximum(self._unmended, self.error)[hands]

    def _is_close(self, tick: int, hand: int) -> bool:
        """Return whether a hand that follows an object is close to where its approach ends."""
        last = self._segment(g1.SIDES[hand], tick).stop - 1
        left = self._targets[last, hand, :3, 3] - self._targets[tick, hand, :3, 3]
        return float(norm(left)) < self.settings.close_m

    def _regain(self, tick: int) -> Iterator[np.ndarray]:
        """Hold the hands where they are while the base steps back to where it stood, before they touch anything."""
        if self.stage != PRE_MANIPULATION:
            return
        while self._stance.steps and self._regain_ticks > 0:
            self._regain_ticks -= 1
            self.activity = "regain"
            yield self._command(self.last_targets, tick)

    def _walk_on(self, tick: int) -> Iterator[np.ndarray]:
        """Walk what is left of a walk that ends with this tick."""
        self.activity = "walk on"
        for _ in range(self.settings.arrive_ticks):
            velocity = self._base_path.remaining_velocity(tick, self._pelvis(tick))
            if velocity is None:
                return
            self._follow_base(tick)
            yield self._command(self._targets[tick], tick, velocity)

    def _segment(self, side: str, tick: int) -> Segment:
        """Return what a hand is at, at a tick; its segments cover the demonstration."""
        return next(entry for entry in self._tracks[side] if entry.start <= tick < entry.stop)

    def _settle(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until hands are beside their objects as they were in the demonstration, moving targets as it takes."""
        self.activity = "settle"
        for targets in self._gripping.settle(tick, self.last_targets, self._motion):
            yield self._command(targets, tick - 1)

    def _verify_grip(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until closed grippers press on their objects; one that closes on nothing has missed its object."""
        self.activity = "grip"
        for _ in self._gripping.verify(tick):
            yield self._command(self._targets[tick], tick)

    def _motion(self, name: str, tick: int) -> np.ndarray:
        """Return the motion (4, 4) of an object from where it was at a tick of the demonstration to where it is."""
        T_W_Od, T_W_O = self.demonstration.T_world_objects[tick, self._names.index(name)], self.world.pose(name)
        return retarget.scene_motion(T_W_Od, T_W_O, self._symmetry(name, T_W_Od, T_W_O, tick))

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

    def _join(self, tick: int, starting: Sequence[Segment]) -> Iterator[np.ndarray]:
        """Lead hands onto the motion that begins: as it goes on, or before it where they come to an object too soon."""
        entries = [entry for entry in starting if entry.kind == "object" or entry.anchor != "base"]
        if not entries:
            return  # hands that follow the base are led there tick by tick
        hands = [g1.SIDES.index(entry.hand) for entry in entries]
        last, path = self.last_targets[hands], self._targets[tick:, hands]
        distance = float(norm((path[0] - last)[:, :3, 3]).max())
        ticks = max(self.settings.min_transit_ticks, int(np.ceil(10.0 * distance / self.settings.transit_speed)))
        room = int(self.settings.joining_share * min(entry.stop - tick for entry in entries))
        if ticks > room:
            yield from self._transit(tick, ticks)
            return
        joined = retarget.join(last, path[:room])
        self._detours[tick : tick + room, hands] = (joined - path[:room])[..., :3, 3]
        self._targets[tick : tick + room, hands] = joined

    def _transit(self, tick: int, ticks: int) -> Iterator[np.ndarray]:
        """Bring the hands from where they are commanded, at first from where they are, to this tick's targets."""
        self.activity = "transit"
        self._follow_base(tick)  # the other hand may do so
        for targets in retarget.transit(self.last_targets, self._targets[tick], ticks):
            yield self._command(targets, tick)

    def _touching(self, tick: int) -> bool:
        return any(
            entry.kind == "proprioception" and entry.object is not None and entry.start <= tick
            for track in self._tracks.values()
            for entry in track
        )

    def _command(self, targets: np.ndarray, tick: int, velocity: np.ndarray | None = None) -> np.ndarray:
        pressing = self._squeeze.tighten(targets, tick)
        solution = self.world.ik.solve(
            T_world_pelvis=self._pelvis(tick),
            joint_positions=self.world.joint_positions(),
            T_world_left=pressing[0],
            T_world_right=pressing[1],
            previous=self.world.command(),
        )
        self.last_targets, self.tick = targets, tick
        self._way.append(targets)
        self.error = solution.position_error
        self._trailing = self._trailing + 1 if self.error.max() > self.settings.hold_error_m else 0
        if self.stage == MANIPULATION and self._trailing >= self.settings.hold_ticks:
            raise StageError("ik_failed", self._out_of_reach(self.settings.hold_error_m, "while it holds on"))
        if self.stage == PRE_MANIPULATION and self.activity != "withdraw":
            self._check_pushed()
        result = solution.command
        result[command.GRIPPERS] = self.demonstration.action[tick, command.GRIPPERS]
        if velocity is None or not velocity.any():
            pelvis, expected = self.world.pose("pelvis"), self._floor_d(tick)
            result[command.VELOCITY] = self._stance.velocity(pelvis, expected, self._leave_m())
        else:
            self._stance.leave()
            result[command.VELOCITY] = velocity
            result[command.HEIGHT] = max(result[command.HEIGHT], self.settings.walk_height)
            result[command.PITCH] = min(result[command.PITCH], self.settings.walk_pitch)
        return result

    def _leave_m(self) -> float:
        """Return how far the base may be from where it stood before it steps back [m]."""
        if not self._adapts or self.activity in ("settle", "grip"):
            return math.inf
        return self._adaptation.leave_m if self.stage == PRE_MANIPULATION else self._adaptation.holding_leave_m

    def _check_pushed(self) -> None:
        for name in self._names:
            motion = poses.invert(self._places[name]) @ self.world.pose(name)
            moved = float(norm(motion[:3, 3]))
            if moved > self.settings.displaced_m:
                raise StageError(
                    "collided",
                    f"the {name} was pushed {moved:.3f} m away before the hands took it (at most "
                    f"{self.settings.displaced_m:g} m)",
                    again=self._adapts and motion[2, 2] > _UPRIGHT,  # one that lies on another side is another start
                )

    def _check_reached(self) -> None:
        if self.error.max() > self.settings.reach_error_m:
            reason = self._out_of_reach(self.settings.reach_error_m, "when it was to take hold")
            raise StageError("ik_failed", reason, again=True)

    def _out_of_reach(self, limit_m: float, when: str) -> str:
        hand = int(self.error.argmax())
        return (
            f"inverse kinematics brings the {g1.SIDES[hand]} palm no nearer to its target than "
            f"{self.error[hand]:.3f} m {when} (at most {limit_m:g} m)"
        )
