"""CarryBox, scripted: palms beside the box, squeeze, lift; walk to the other table; lower, let go, draw back.

This stands in for a person with a headset and a stick to walk with; it does not touch joints, and it does not see
contact forces.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.carry_box import BOX_SIZE, TABLE_HEIGHT
from lerobot_demohlm.generation.locomotion import LocomotionSettings, walk
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.path import HandPath, PathOperator, Waypoint

START: InitialState = {"robot": [0.0, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the box in reach before its chest."""

SQUEEZE = 0.02  # m, how far inside the box's sides the palms are asked to be
BESIDE = 0.07  # m, beside the box before the squeeze and after it
GRIP_HEIGHT, GRIP_NEAR = 0.02, 0.03  # m, the palms above the box's middle, and from it towards the robot
TILT = 0.35  # rad, fingers down
LIFTED, HELD_AHEAD = 0.14, 0.34  # m, the box above the table, and its middle ahead of the pelvis
STANCE = 0.40  # m that the goal is ahead of the pelvis: clear of its table, and in reach after a drift back
ABOVE = 0.004  # m, the box is let go at this height above the table
WALK = replace(LocomotionSettings(), max_velocity=(0.3, 0.2, 0.2, 0.4), max_ticks=400, max_walks=8)


class CarryBoxOperator:
    """Reaches and lifts along a path, walks with the hands where they are on the robot, and sets down along a path."""

    name = "scripted: carry_box"

    def __init__(self) -> None:
        self._take = PathOperator(self.name, [_take])
        self._set_down: Iterator[np.ndarray] | None = None
        self._walk: Iterator[np.ndarray] | None = None
        self._T_world_pelvis = np.eye(4)
        self._T_world_hands = self._T_base_hands = np.tile(np.eye(4), (2, 1, 1))

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick; None once the hands are drawn back."""
        asked = self._take.poses(view)
        if asked is not None:
            self._T_world_hands = asked.T_world_hands
            return asked
        self._T_world_pelvis = view.T_world_pelvis
        T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
        if self._walk is None:
            self._T_base_hands = poses.invert(T_world_base) @ self._T_world_hands
            x, y, _ = view.T_world_objects["goal"][:3, 3]
            goal = np.array([x, y + STANCE, -np.pi / 2])
            self._walk = walk(lambda: self._T_world_pelvis, goal, WALK)
        wanted = next(self._walk, None)
        if wanted is not None:
            self._T_world_hands, velocity = T_world_base @ self._T_base_hands, wanted[command.VELOCITY]
            return _asked(self._T_world_hands, velocity)
        if self._set_down is None:  # from where the hands are asked to be, so that they go on squeezing
            self._set_down = iter(HandPath(self._T_world_hands, _set_down(view, self._T_world_hands)).T_world_hands)
        hands = next(self._set_down, None)
        return None if hands is None else _asked(hands, np.zeros(3))


def _asked(T_world_hands: np.ndarray, velocity: np.ndarray) -> OperatorPoses:
    return OperatorPoses(T_world_head=None, T_world_hands=T_world_hands, grippers=np.zeros(2), velocity=velocity)


def make_operator() -> CarryBoxOperator:
    """Return the operator of this task."""
    return CarryBoxOperator()


def _palms(T_world_frame: np.ndarray, x: float, half_gap: float, z: float) -> np.ndarray:
    rotation = poses.rotation_from_rpy([0.0, TILT, 0.0])
    return T_world_frame @ poses.from_rotation(rotation, [[x, half_gap, z], [x, -half_gap, z]])


def _take(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way to the box, which faces as the robot does, and up."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_box = view.T_world_objects["box"]
    wide, grip = BOX_SIZE[1] / 2 + BESIDE, BOX_SIZE[1] / 2 - SQUEEZE
    raised = float(T_world_box[2, 3]) + LIFTED + GRIP_HEIGHT
    above = _palms(T_world_box, -GRIP_NEAR - 0.06, wide + 0.04, GRIP_HEIGHT + 0.14)
    around = _palms(T_world_box, -GRIP_NEAR, wide, GRIP_HEIGHT)
    gripped = _palms(T_world_box, -GRIP_NEAR, grip, GRIP_HEIGHT)
    lifted = _palms(T_world_base, HELD_AHEAD - GRIP_NEAR, grip, raised)
    return [
        Waypoint(T_world_hands=above, duration_s=1.4),
        Waypoint(T_world_hands=around, duration_s=1.3),
        Waypoint(T_world_hands=gripped, duration_s=0.8),
        Waypoint(T_world_hands=gripped, duration_s=0.2),
        Waypoint(T_world_hands=lifted, duration_s=2.4),
        Waypoint(T_world_hands=lifted, duration_s=0.2),
    ]


def _set_down(view: SceneView, T_world_hands: np.ndarray) -> Sequence[Waypoint]:
    """Plan the way over the other table and down, letting go, and the way back, with the grip that the palms have."""
    T_world_box, goal = view.T_world_objects["box"], view.T_world_objects["goal"][:3, 3]
    level = poses.planar(float(goal[0]), float(goal[1]), float(poses.yaw(T_world_box)))
    level[2, 3] = float(goal[2]) + TABLE_HEIGHT + BOX_SIZE[2] / 2 + ABOVE
    over = level.copy()
    over[2, 3] += LIFTED
    grip = poses.invert(T_world_box) @ T_world_hands
    outwards = grip[:, :3, 3] - grip[:, :3, 3].mean(axis=0)
    outwards /= np.sqrt((outwards**2).sum(axis=1, keepdims=True))
    aside = grip.copy()
    aside[:, :3, 3] += (SQUEEZE + BESIDE) * outwards
    away = aside.copy()
    away[:, 2, 3] += 0.16
    return [
        Waypoint(T_world_hands=over @ grip, duration_s=1.6),
        Waypoint(T_world_hands=over @ grip, duration_s=0.2),
        Waypoint(T_world_hands=level @ grip, duration_s=2.0),
        Waypoint(T_world_hands=level @ grip, duration_s=0.2),
        Waypoint(T_world_hands=level @ aside, duration_s=1.0),
        Waypoint(T_world_hands=level @ away, duration_s=1.4),
        Waypoint(T_world_hands=level @ away, duration_s=0.6),
    ]
