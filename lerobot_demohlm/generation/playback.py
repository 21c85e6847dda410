"""A demonstration and one world -> the commands of pre-manipulation and manipulation, by inverse kinematics."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import groups
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import retarget, tables
from lerobot_demohlm.generation.base_path import BasePath
from lerobot_demohlm.generation.carrying import Carrying
from lerobot_demohlm.generation.gripping import Gripping
from lerobot_demohlm.generation.hand_targets import HandTargets, Started
from lerobot_demohlm.generation.handing_over import HandingOver
from lerobot_demohlm.generation.squeeze import Squeeze
from lerobot_demohlm.generation.stages import (
    MANIPULATION,
    PRE_MANIPULATION,
    RetreatSettings,
    Settings,
    StageError,
)
from lerobot_demohlm.generation.stance import Stance
from lerobot_demohlm.generation.world_view import WorldView

_LEVEL_M = 0.02  # m, by which something that was not taken hold of is higher or lower than it began
_UPRIGHT = 0.98  # cosine of the tilt up to which a thing stands as it did


class Playback:
    """The demonstration's hand motion, carried over to where robot and objects are.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        segments: Its segments.
        symmetry: (4, 4) the chosen symmetry of the first object.
        settings: Limits and times.
        over_m: Height [m] to which hands rise before they reach out over a table; None where they need not.
        handing_over: How hands keep to the way of a thing that one pushes onto the other; None where none does.

    Attributes:
        stage: "pre_manipulation" or "manipulation".
        tick: Of the demonstration, which the last command was for.
        activity: What that command did: "follow" the demonstration, "transit" to where a part of it begins, "wait" for
            the torso, "regain" the stance, "settle" a gripper, "grip" an object, "walk on", "hold" still at the end, or
            "withdraw" after a failure.
        error: (2,) what inverse kinematics left of the way to them [m].
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        symmetry: np.ndarray,
        settings: Settings,
        over_m: float | None = None,
        handing_over: HandingOver | None = None,
    ) -> None:
        self.world, self.task, self.demonstration = world, task, demonstration
        self.settings = settings.playback
        self.stage, self.tick, self.activity = PRE_MANIPULATION, 0, "transit"
        self._names = [entry.name for entry in task.objects]
        self._groups = groups(segments)
        self._carrying = Carrying(world, task, demonstration, segments, settings.walking)
        self._hands = HandTargets(
            world, task, demonstration, segments, symmetry, self._carrying, self.settings, over_m, handing_over
        )
        self._handing_over = handing_over
        self._over_m, self._back_m, self._reaching = over_m, settings.tables.back_m, tables.reaching(segments)
        self.error, self._trailing = np.zeros(len(g1.SIDES)), 0
        self._unmended = np.zeros(len(g1.SIDES))  # m, errors that no waiting for the torso has mended
        self._way = [self._hands.last]  # of the hands so far
        self._base_path = BasePath(demonstration, self.settings)
        share = settings.adaptation.squeeze if settings.adapts else 0.0
        self._squeeze = Squeeze(world, task, demonstration, share, settings.adaptation.max_squeeze_m)
        self._adapts, self._adaptation = settings.adapts, settings.adaptation
        self._places = {name: world.pose(name) if self._adapts else world.start_pose(name) for name in self._names}
        self._regain_ticks = settings.adaptation.regain_ticks  # that are left
        self._stance = Stance(settings.locomotion.window_ticks, settings.adaptation.drift_gain)
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
            if tick == 0 and self._over_m is not None:
                yield from self._rise(self._over_m)
            self._hands.begin(tick, starting)
            entries = [entry for group in starting for entry in group]
            if any(entry.kind == "object" for entry in entries) or tick == 0:
                yield from self._transit(tick, self._hands.join(tick, entries))
            if self.stage == PRE_MANIPULATION and self._touching(tick):
                self._check_reached()
                self.stage = MANIPULATION
            self._hands.follow_base(tick)
            if self._carrying.begins(tick):
                yield from self._carry(tick)
                continue
            yield from self._regain(tick)
            self._hands.steer(tick)
            self.activity = "follow"
            velocity = self._base_path.velocity(tick, self._hands.pelvis(tick))
            yield self._command(self._hands.at(tick), tick, velocity)
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
    def last_targets(self) -> np.ndarray:
        """Poses (2, 4, 4) of the palms that the last command aimed at; at first, where they are."""
        return self._hands.last

    @property
    def started(self) -> list[Started]:
        """Segments that have begun, in the order of time."""
        return self._hands.started

    @property
    def delicate(self) -> bool:
        """Whether the last command has to do with a touch or a gripper's switch, and is to be executed as planned."""
        before, after = self.settings.delicate_ticks
        near = any(-before <= self.tick - switch <= after for switch in self._switches)
        return near or self.activity not in ("transit", "follow", "walk on")

    @property
    def left_in_place(self) -> bool:
        """Whether every object still is as high as it began, and no object lies on another side."""
        motions = [poses.invert(self.world.start_pose(name)) @ self.world.pose(name) for name in self._names]
        return all(abs(motion[2, 3]) < _LEVEL_M and motion[2, 2] > _UPRIGHT for motion in motions)

    def withdraw(self, settings: RetreatSettings) -> Iterator[np.ndarray]:
        """Yield commands that open the grippers and take the hands back the way they came."""
        self.stage, self.activity = PRE_MANIPULATION, "withdraw"
        back = self._way[::-1]
        for targets in [*back[:1] * settings.release_ticks, *back[:: settings.speed], back[-1]]:
            yield self._command(targets, 0)

    def _carry(self, tick: int) -> Iterator[np.ndarray]:
        """Walk to the goal of what the hands hold, which stay where they are on the robot."""
        self.activity = "walk on"
        for velocity in self._carrying.walk(tick):
            self._hands.follow_base(tick)
            yield self._command(self._hands.at(tick), tick, velocity)
        self._stance.leave()  # it stands for another part of the demonstration now

    def _await_torso(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until the torso has bent so far that hands close to their objects are where they should be by now.

        A torso bends slowly. Hands that went on would come down on an object from aside. What remains when the torso
        has come to rest is not waited for again.
        """
        hands = [hand for hand in self._hands.motions if self._hands.is_close(tick, hand)]

        def left() -> float:
            return float((self.error - self._unmended)[hands].max(initial=0.0))

        least, patience = left(), self.settings.patience_ticks
        while least > self.settings.torso_error_m and patience > 0:
            self.activity = "wait"
            yield self._command(self._hands.at(tick), tick)
            error = left()
            patience = self.settings.patience_ticks if error < least - self.settings.torso_gain_m else patience - 1
            least = min(least, error)
        if patience == 0:
            self._unmended[hands] = np.maximum(self._unmended, self.error)[hands]

    def _regain(self, tick: int) -> Iterator[np.ndarray]:
        """Hold the hands where they are while the base steps back to where it stood, before they touch anything."""
        if self.stage != PRE_MANIPULATION:
            return
        while self._stance.steps and self._regain_ticks > 0:
            self._regain_ticks -= 1
            self.activity = "regain"
            yield self._command(self._hands.last, tick)

    def _walk_on(self, tick: int) -> Iterator[np.ndarray]:
        """Walk what is left of a walk that ends with this tick."""
        self.activity = "walk on"
        for _ in range(self.settings.arrive_ticks):
            velocity = self._base_path.remaining_velocity(tick, self._hands.pelvis(tick))
            if velocity is None:
                return
            self._hands.follow_base(tick)
            yield self._command(self._hands.at(tick), tick, velocity)

    def _settle(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until hands are beside their objects as they were in the demonstration, moving targets as it takes."""
        self.activity = "settle"
        for targets in self._gripping.settle(tick, self._hands.last, self._hands.object_motion):
            yield self._command(targets, tick - 1)

    def _verify_grip(self, tick: int) -> Iterator[np.ndarray]:
        """Wait until closed grippers press on their objects; one that closes on nothing has missed its object."""
        self.activity = "grip"
        for _ in self._gripping.verify(tick):
            yield self._command(self._hands.at(tick), tick)

    def _transit(self, tick: int, ticks: int) -> Iterator[np.ndarray]:
        """Bring the hands from where they are commanded, at first from where they are, to this tick's targets."""
        if ticks == 0:
            return
        self.activity = "transit"
        self._hands.follow_base(tick)  # the other hand may do so
        for targets in retarget.transit(self._hands.last, self._hands.at(tick), ticks):
            yield self._command(targets, tick)

    def _rise(self, height_m: float) -> Iterator[np.ndarray]:
        """Raise the hands that are about to reach out to a height [m] in front of the robot; higher ones stay."""
        self.activity = "transit"
        back = -self._back_m * poses.heading(self.world.pose("pelvis"))[:2, 0]
        risen = tables.risen(self._hands.last, self._reaching, height_m, back)
        if (risen == self._hands.last).all():
            return
        ticks = self.settings.transit_ticks(self._hands.last, risen)
        for targets in retarget.transit(self._hands.last, risen, ticks):
            yield self._command(targets, 0)

    def _touching(self, tick: int) -> bool:
        return any(
            entry.kind == "proprioception" and entry.object is not None and entry.start <= tick
            for group in self._groups
            for entry in group
        )

    def _command(self, targets: np.ndarray, tick: int, velocity: np.ndarray | None = None) -> np.ndarray:
        pressing = self._squeeze.tighten(targets, tick)
        if self._handing_over is not None and self.activity != "withdraw":
            pressing = self._handing_over.levelled(pressing, tick)
        solution = self.world.ik.solve(
            T_world_pelvis=self._hands.pelvis(tick),
            joint_positions=self.world.joint_positions(),
            T_world_left=pressing[0],
            T_world_right=pressing[1],
            previous=self.world.command(),
        )
        self._hands.last, self.tick = targets, tick
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
            pelvis, expected = self.world.pose("pelvis"), self._hands.base_then(tick)
            result[command.VELOCITY] = self._stance.velocity(pelvis, expected, self._leave_m())
        else:
            self._stance.leave()
            result[command.VELOCITY] = velocity
            result[command.HEIGHT] = max(result[command.HEIGHT], self.settings.walk_height)
            result[command.PITCH] = min(result[command.PITCH], self.settings.walk_pitch)
        return result

    def _leave_m(self) -> float:
        """Return how far the base may be from where it stood before it steps back [m]."""
        if not self._adapts or self.activity in ("settle", "grip", "withdraw"):
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
