"""How a device moves -> where the robot's palms and head should go: motion counts from where a hand was engaged.

A person's room and the robot's world have nothing in common but the vertical. So a device's pose never counts by
itself: at the moment a hand is engaged, the device is where it is and the palm's target is where it is, and from then
on the target makes the device's motion, turned from the operator's heading to the robot's. Where a headset draws the
robot in the operator's room, that heading is the drawn robot's; elsewhere it is the one in which the operator looks. A
hand that is let go holds. Engaging again, or tracking that comes back, begins anew from the target as it stands:
nothing jumps.

Poses of devices have x forward, y left, z up; only differences of them are used.
"""

from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.robot import g1
from gym_demohlm.robot.g1 import SIDES
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView

SILENCE_S = 0.15  # age of the newest controls from which nobody is there: one step later, at most 0.3 s, it stands
GLITCH_M = 0.3  # in one step of 0.1 s: no hand moves so fast, tracking has jumped
RETURN_M = 0.1  # a hand that has moved less while nothing was heard of it goes on; one that moved further begins anew
LEASH_M = 0.12  # how far keys and sticks may lead a palm's target from the palm, so that it does not run away
HAND_SPEED = np.array([0.25, 0.25, 0.25, 1.0, 1.0, 1.0])  # m/s and rad/s of a hand rate of 1
WALK_SPEED = ((-0.25, 0.45), (-0.25, 0.25), (-0.5, 0.5))  # m/s, m/s, rad/s of a stick at -1 and 1
DEAD_ZONE = 0.12  # of a stick
SETTLING_STEPS = 20  # after a walk, in which a robot still steps and its hands go with it (2 s)
LIFT_SPEED = 0.2  # m/s
DEEPEST_SQUAT = command.LOWER[command.HEIGHT] - g1.PELVIS_HEIGHT  # m
GRIP_NEAR = 0.15  # a trigger this near to the gripper's value takes it over at once


@dataclass(frozen=True, kw_only=True)
class HandControls:
    """What a device says of one hand.

    Attributes:
        pose: (4, 4) of the device in the operator's room; None where it is not tracked, or has no pose.
        engaged: Whether the operator holds the clutch.
        grip: The trigger, 0 open .. 1 closed.
        rate: (6,) by which keys or sticks move the hand, each in [-1, 1]: forward, left, up, and turns about these
            axes, in the robot's heading.
    """

    pose: np.ndarray | None = None
    engaged: bool = False
    grip: float = 0.0
    rate: np.ndarray = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, kw_only=True)
class Controls:
    """What an operator does at one moment.

    Attributes:
        left: The left hand.
        right: The right hand.
        head: (4, 4) pose of the head in the operator's room; None where the device has none.
        lean: Whether the head's motion moves the robot's head, and the torso with it; its heading counts anyway.
        heading: What counts as the robot's forward in the operator's room [rad], from x to y, as where the robot is
            drawn in a headset; None: the head's heading, or 0 without a head.
        walk: (3,) forward, left, turn left, each in [-1, 1].
        lift: -1 squats, 1 rises, 0 stays.
        age_s: How long ago this was heard of [s].
        driver: Number of the operator; another number is another person, whose hands are elsewhere.
    """

    left: HandControls = field(default_factory=HandControls)
    right: HandControls = field(default_factory=HandControls)
    head: np.ndarray | None = None
    lean: bool = True
    heading: float | None = None
    walk: np.ndarray = field(default_factory=lambda: np.zeros(3))
    lift: float = 0.0
    age_s: float = 0.0
    driver: int = 0

    @property
    def hands(self) -> tuple[HandControls, HandControls]:
        """Left and right."""
        return self.left, self.right

    @property
    def active(self) -> bool:
        """Whether the operator does anything that moves the robot."""
        if self.age_s > SILENCE_S:
            return False
        return any(hand.engaged for hand in self.hands) or bool(np.abs(self.walk).max() > DEAD_ZONE) or self.lift != 0.0


class PoseClutch:
    """One target that follows one device, relative to where it was engaged.

    Args:
        scale: Metres of the target for a metre of the device.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._scale = scale
        self._device: np.ndarray | None = None  # (4, 4) where it was engaged; None while it is not
        self._target = np.eye(4)  # (4, 4) where the target was then
        self._turn = np.eye(3)  # from the operator's room to the robot's world
        self._last: np.ndarray | None = None  # (3,) where the device was a step ago [m]
        self._paused = False

    @property
    def engaged(self) -> bool:
        """Whether the target follows the device."""
        return self._device is not None

    def release(self) -> None:
        """Let go: the next device pose counts as engaged anew."""
        self._device = self._last = None

    def pause(self) -> None:
        """Note that nothing is heard of the device: it goes on from there if it comes back near to where it was."""
        self._paused = True

    def carry(self, T_world_moved: np.ndarray) -> None:
        """Move with the robot: ``T_world_moved`` (4, 4) is its motion in the world."""
        self._target = T_world_moved @ self._target
        self._turn = T_world_moved[:3, :3] @ self._turn

    def shift(self, offset: np.ndarray) -> None:
        """Move what follows by an offset (3,) [m]."""
        self._target = self._target.copy()
        self._target[:3, 3] += offset

    def follow(
        self, target: np.ndarray, device: np.ndarray | None, operator_yaw: float, robot_yaw: float
    ) -> np.ndarray:
        """Return the target (4, 4) of this step.

        Args:
            target: (4, 4) of the step before; what it stays at where the device has just been engaged, or is lost.
            device: (4, 4) in the operator's room; None where it is not tracked.
            operator_yaw: Heading of the operator in that room [rad]; counts when the device is engaged.
            robot_yaw: Heading of the robot in the world [rad], the same.
        """
        if device is None:
            self.release()
            return target
        limit, self._paused = RETURN_M if self._paused else GLITCH_M, False
        glitch = self._last is not None and np.linalg.norm(device[:3, 3] - self._last) > limit
        self._last = device[:3, 3].copy()
        if self._device is None or glitch:
            self._device, self._target = device.copy(), target.copy()
            self._turn = poses.planar(0.0, 0.0, robot_yaw - operator_yaw)[:3, :3]
            return target
        moved = self._target.copy()
        moved[:3, 3] += self._scale * (self._turn @ (device[:3, 3] - self._device[:3, 3]))
        turned = self._turn @ device[:3, :3] @ self._device[:3, :3].T @ self._turn.T
        moved[:3, :3] = turned @ self._target[:3, :3]
        return moved


class Clutch:
    """Controls of both hands, head and sticks -> the poses and velocity that an operator asks for.

    Targets stay where they are in the world while the robot stands, and go with it while it walks and comes to rest:
    what it holds has gone on with it.

    Args:
        scale: Metres of a palm for a metre of a hand.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._hands = [PoseClutch(scale) for _ in SIDES]
        self._head = PoseClutch(scale)
        self._led = [False, False]  # by keys or sticks
        self._targets: np.ndarray | None = None  # (2, 4, 4)
        self._head_target: np.ndarray | None = None  # (4, 4)
        self._squat = 0.0  # m below the standing height
        self._grippers = np.zeros(2)
        self._grip_live = [False, False]
        self._base: np.ndarray | None = None  # (4, 4) on the floor, of the step before, while targets go with it
        self._settling = 0  # steps for which they still do
        self._driver = 0

    @property
    def engaged(self) -> tuple[bool, bool]:
        """Whether the left and the right palm follow a device, keys or sticks."""
        left, right = (clutch.engaged or led for clutch, led in zip(self._hands, self._led, strict=True))
        return left, right

    @property
    def grippers(self) -> tuple[float, float]:
        """What is asked of the left and the right gripper, 0 open .. 1 closed."""
        left, right = self._grippers.tolist()
        return left, right

    @property
    def squat(self) -> float:
        """How far the buttons have moved the head [m], 0 or less."""
        return self._squat

    def reset(
        self,
        T_world_hands: np.ndarray | None = None,
        grippers: np.ndarray | None = None,
        T_world_head: np.ndarray | None = None,
        squat: float = 0.0,
    ) -> None:
        """Let go of everything and hold these targets, as after going back in time.

        Args:
            T_world_hands: (2, 4, 4); where the palms are measured next, if not given.
            grippers: (2,) 0 open .. 1 closed; open if not given.
            T_world_head: (4, 4); None leaves the torso to the hands.
            squat: How far the buttons have moved that head [m], 0 or less.
        """
        self._let_go()
        self._led = [False, False]
        self._targets = None if T_world_hands is None else T_world_hands.copy()
        self._grippers = np.zeros(2) if grippers is None else np.array(grippers, dtype=np.float64)
        self._head_target = None if T_world_head is None else T_world_head.copy()
        self._squat = float(np.clip(squat, DEEPEST_SQUAT, 0.0))
        self._base, self._settling = None, 0

    def _let_go(self) -> None:
        """Have hands and head begin anew from where they are, and grippers wait for their triggers."""
        for clutch in (*self._hands, self._head):
            clutch.release()
        self._grip_live = [False, False]

    def rebase(self, view: SceneView) -> None:
        """Let go of everything and hold what the robot does now: its world begins anew, and the robot stays.

        Args:
            view: The robot in the new world.
        """
        head = None if self._head_target is None else view.T_world_head
        self.reset(view.T_world_hands, self._grippers, head, self._squat)

    def poses(self, controls: Controls, view: SceneView) -> OperatorPoses:
        """Return what the robot should do in this step of 0.1 s.

        Args:
            controls: The newest; where they are older than ``SILENCE_S`` the robot stands and holds.
            view: The robot as measured.
        """
        if self._targets is None:
            self._targets = view.T_world_hands.copy()
        if controls.driver != self._driver:
            self._let_go()
            self._driver = controls.driver
        present = controls.age_s <= SILENCE_S
        velocity = self._velocity(controls.walk) if present else np.zeros(3)
        base = poses.planar(*poses.to_planar(view.T_world_pelvis))
        self._carry(base, walking=bool(velocity.any()))
        robot_yaw = float(poses.yaw(base))
        operator_yaw = _operator_yaw(controls)
        for index, (hand, clutch) in enumerate(zip(controls.hands, self._hands, strict=True)):
            self._led[index] = present and hand.engaged and bool(hand.rate.any())
            if not present:
                clutch.pause()
                continue
            if not hand.engaged:
                clutch.release()
                self._grip_live[index] = False
                continue
            target = clutch.follow(self._targets[index], hand.pose, operator_yaw, robot_yaw)
            if hand.rate.any():
                nudged = _nudged(target, hand.rate, base, view.T_world_hands[index])
                if hand.pose is not None:  # the device turns the hand, the sticks move it
                    clutch.shift(nudged[:3, 3] - target[:3, 3])
                    nudged[:3, :3] = target[:3, :3]
                target = nudged
            self._targets[index] = target
            self._grippers[index] = self._grip(index, hand)
        self._follow_head(controls, view, present, operator_yaw, robot_yaw)
        return OperatorPoses(
            T_world_head=None if self._head_target is None else self._head_target.copy(),
            T_world_hands=self._targets.copy(),
            grippers=self._grippers.copy(),
            velocity=velocity,
        )

    def _velocity(self, walk: np.ndarray) -> np.ndarray:
        """Return the base velocity (3,) [m/s, m/s, rad/s] of sticks."""
        pushed = np.sign(walk) * np.clip((np.abs(walk) - DEAD_ZONE) / (1.0 - DEAD_ZONE), 0.0, 1.0)
        return np.array([-low * x if x < 0 else high * x for x, (low, high) in zip(pushed, WALK_SPEED, strict=True)])

    def _carry(self, base: np.ndarray, *, walking: bool) -> None:
        """Take the targets along with a robot that walks; (4, 4) is where it is on the floor."""
        assert self._targets is not None  # poses has set them
        if self._base is not None:
            moved = base @ poses.invert(self._base)
            self._targets = moved @ self._targets
            if self._head_target is not None:
                self._head_target = moved @ self._head_target
            for clutch in (*self._hands, self._head):
                clutch.carry(moved)
        self._settling = SETTLING_STEPS if walking else max(self._settling - 1, 0)
        self._base = base if self._settling else None

    def _grip(self, index: int, hand: HandControls) -> float:
        """Return the gripper's value: the trigger's; a gripper left closed waits until the trigger is pressed again."""
        held = float(self._grippers[index])
        if held <= 0.5 or abs(hand.grip - held) <= GRIP_NEAR:
            self._grip_live[index] = True
        return float(np.clip(hand.grip, 0.0, 1.0)) if self._grip_live[index] else held

    def _follow_head(
        self, controls: Controls, view: SceneView, present: bool, operator_yaw: float, robot_yaw: float
    ) -> None:
        """Set the head's target: the device's motion where it has a head, else how far the buttons squat."""
        if not present:
            self._head.pause()
            return
        engaged = any(hand.engaged for hand in controls.hands)
        if controls.lift:
            step = float(np.clip(controls.lift, -1.0, 1.0)) * LIFT_SPEED * STEP_DT
            squat = float(np.clip(self._squat + step, DEEPEST_SQUAT, 0.0))
            if self._head_target is None:
                self._head_target = view.T_world_head.copy()
            self._head_target[2, 3] += squat - self._squat
            self._head.release()
            rising = squat == 0.0 and controls.head is None
            self._squat = squat
            if rising:
                self._head_target = None
            return
        if not engaged or controls.head is None or not controls.lean:
            self._head.release()
            return
        target = view.T_world_head if self._head_target is None else self._head_target
        self._head_target = self._head.follow(target, controls.head, operator_yaw, robot_yaw).copy()


def _operator_yaw(controls: Controls) -> float:
    """Return what counts as forward in the operator's room [rad]."""
    if controls.heading is not None:
        return controls.heading
    return 0.0 if controls.head is None else _heading(controls.head)


def _heading(T: np.ndarray) -> float:
    """Return the heading [rad] of a head: of its forward axis, or, where it looks straight down, of its crown."""
    forward = T[:3, 0] if abs(T[2, 0]) < 0.9 else -np.sign(T[2, 0]) * T[:3, 2]
    return float(np.arctan2(forward[1], forward[0]))


def _nudged(target: np.ndarray, rate: np.ndarray, base: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """Return a target (4, 4) moved by keys or sticks, not further than a leash from the palm as measured."""
    step = np.clip(rate, -1.0, 1.0) * HAND_SPEED * STEP_DT
    moved = target.copy()
    wanted = target[:3, 3] + base[:3, :3] @ step[:3]
    before, after = (float(np.linalg.norm(p - palm[:3, 3])) for p in (target[:3, 3], wanted))
    if after <= LEASH_M or after < before:
        moved[:3, 3] = wanted
    turn = base[:3, :3] @ poses.rotation_from_vector(step[3:]) @ base[:3, :3].T
    moved[:3, :3] = turn @ target[:3, :3]
    return moved
