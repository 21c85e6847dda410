"""PushCart, scripted: both grippers close round the bar from behind, then the robot walks ahead with it and stops.

This stands in for a person with a headset and a stick to walk with; it does not touch joints, and it does not see
contact forces.
"""

import math
from collections.abc import Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.push_cart import BAR_X, CART_POSITION
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

STANCE = 0.40  # m that the bar is ahead of the pelvis
START: InitialState = {"robot": [CART_POSITION[0] + BAR_X - STANCE, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the bar before its chest, the deck clear of its feet."""

GRIP_Y = 0.19  # m, the hands on either side of the posts
RAISED = (0.22, 0.24, 0.08)  # m, ahead of and beside the pelvis, and above the bar
BACK = 0.09  # m before the bar: where the open jaws line up
PALMS_DOWN = math.pi / 2  # rad, the roll with which the jaws close from above and below
SPEED, PUSH_S, SLOW_S = 0.30, 4.0, 0.5  # m/s, s, s: it begins and ends at half the speed
HOLD_S = 2.4  # s, standing behind the cart
CLOSED = 1.0


class PushCartOperator:
    """Reaches and grips along a path, then walks and stands again, the hands where they are on the robot."""

    name = "scripted: push_cart"

    def __init__(self) -> None:
        self._reach = PathOperator(self.name, [_reach_and_grip])
        self._tick = 0
        self._T_world_hands = np.tile(np.eye(4), (2, 1, 1))
        self._T_base_hands: np.ndarray | None = None

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick; None once it has stood for a while."""
        asked = self._reach.poses(view)
        if asked is not None:
            self._T_world_hands = asked.T_world_hands
            return asked
        T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
        if self._T_base_hands is None:
            self._T_base_hands = poses.invert(T_world_base) @ self._T_world_hands
        self._tick += 1
        time_s = STEP_DT * self._tick
        if time_s > PUSH_S + HOLD_S:
            return None
        return OperatorPoses(
            T_world_head=None,
            T_world_hands=T_world_base @ self._T_base_hands,
            grippers=np.full(2, CLOSED),
            velocity=np.array([_speed(time_s), 0.0, 0.0]),
        )


def _speed(time_s: float) -> float:
    """Return how fast to walk [m/s] some time after the start of the push."""
    if time_s > PUSH_S:
        return 0.0
    return SPEED / 2 if time_s <= SLOW_S or time_s > PUSH_S - SLOW_S else SPEED


def make_operator() -> PushCartOperator:
    """Return the operator of this task."""
    return PushCartOperator()


def _reach_and_grip(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way to the bar in the bar's frame."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_bar = view.T_world_objects["bar"]

    def hands(T_world_frame: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
        rolls = poses.rotation_from_rpy([[PALMS_DOWN, 0.0, 0.0], [-PALMS_DOWN, 0.0, 0.0]])
        return T_world_frame @ poses.from_rotation(rolls, [[x, y, z], [x, -y, z]])

    raised = hands(T_world_base, RAISED[0], RAISED[1], float(T_world_bar[2, 3]) + RAISED[2])
    before = hands(T_world_bar, -BACK, GRIP_Y, 0.0)
    around = hands(T_world_bar, 0.0, GRIP_Y, 0.0)
    return [
        Waypoint(T_world_hands=raised, duration_s=1.6),
        Waypoint(T_world_hands=before, duration_s=1.2),
        Waypoint(T_world_hands=around, duration_s=1.2),
        Waypoint(T_world_hands=around, duration_s=0.6),
        Waypoint(T_world_hands=around, duration_s=1.0, grippers=CLOSED),
    ]
