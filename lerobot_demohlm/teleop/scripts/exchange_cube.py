"""ExchangeCube, scripted: the right gripper lifts the cube, the left one takes it across and carries it away.

The right fingers hold two sides of the cube, the left ones, turned by a quarter, its top and bottom: so they do not
meet. This stands in for a person with a headset: it sends poses and gripper commands and sees no contact forces.
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [0.01, 0.16, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: 0.34 m before the cube, which is on its right, so far
that the right upper arm stays clear of the trunk."""

TILT = 0.35  # rad, right fingers down while they go to the cube
GRIP_NEAR = 0.005  # m from the cube's centre towards the robot
MEET = (0.34, -0.13, 0.95)  # m, where the cube changes hands: ahead and left of the base, above the floor
LEFT_YAW = -1.2  # rad, the left fingers point inwards, past the end of the right ones
LEFT_FAR = 0.037  # m that the left palm stays back from the cube's centre, along its fingers
PULL_BACK = 0.09  # m, the right hand afterwards
CARRIED = (0.27, 0.27, 0.90)  # m, where the cube ends, as MEET


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    plan = _Plan()
    return PathOperator("scripted: exchange_cube", [plan.take, plan.exchange])


def _left(position: np.ndarray) -> np.ndarray:
    """Return the left palm that holds the top and bottom of a cube at a position."""
    rotation = poses.rotation_from_rpy([math.pi / 2, 0.0, LEFT_YAW])
    return poses.from_rotation(rotation, position - LEFT_FAR * rotation[:, 0])


class _Plan:
    """Both phases, in the frame of the base as it stood at the beginning: the right hand stays where it waits."""

    def __init__(self) -> None:
        self._base = np.eye(4)

    def take(self, view: SceneView) -> list[Waypoint]:
        """Plan the way of the right hand to the cube and up; the left one waits aside."""
        base = self._base = poses.planar(*poses.to_planar(view.T_world_pelvis))
        T = view.T_world_objects["cube"]
        yaw = float(poses.wrap_angle(poses.yaw(base) - poses.yaw(T)))
        T = T @ poses.planar(0.0, 0.0, math.pi / 2 * round(yaw / (math.pi / 2)))
        tilted = poses.rotation_from_rpy([0.0, TILT, 0.0])
        level = np.eye(3)
        aside = base @ _left(np.array([MEET[0] - 0.06, MEET[1] + 0.24, MEET[2]]))
        meet = base @ poses.from_rotation(level, [MEET[0] - GRIP_NEAR, MEET[1], MEET[2]])

        def right(x: float, z: float) -> np.ndarray:
            return T @ poses.from_rotation(tilted, [x - GRIP_NEAR, 0.0, z])

        def hands(palm: np.ndarray) -> np.ndarray:
            return np.stack([aside, palm])

        return [
            Waypoint(T_world_hands=hands(right(-0.13, 0.10)), duration_s=2.0),
            Waypoint(T_world_hands=hands(right(-0.10, 0.03)), duration_s=1.0, watched=True),
            Waypoint(T_world_hands=hands(right(0.0, 0.004)), duration_s=1.2, watched=True),
            Waypoint(T_world_hands=hands(right(0.0, 0.004)), duration_s=1.0, watched=True),
            Waypoint(T_world_hands=hands(right(0.0, 0.004)), duration_s=0.8, grippers=(0.0, 1.0)),
            Waypoint(T_world_hands=hands(right(-0.02, 0.12)), duration_s=1.2, grippers=(0.0, 1.0)),
            Waypoint(T_world_hands=hands(meet), duration_s=1.5, grippers=(0.0, 1.0)),
            Waypoint(T_world_hands=hands(meet), duration_s=1.0, grippers=(0.0, 1.0)),
        ]

    def exchange(self, view: SceneView) -> list[Waypoint]:
        """Plan the way of the left hand to the cube where it is now, the letting go, and the way out."""
        base = self._base
        cube = (poses.invert(base) @ view.T_world_objects["cube"])[:3, 3]
        right = poses.from_rotation(np.eye(3), [MEET[0] - GRIP_NEAR, MEET[1], MEET[2]])
        taken = _left(cube)
        before = taken.copy()
        before[:3, 3] -= 0.12 * taken[:3, 0]
        back = right.copy()
        back[0, 3] -= PULL_BACK
        carried = _left(np.array(CARRIED))

        def hands(left: np.ndarray, palm: np.ndarray) -> np.ndarray:
            return base @ np.stack([left, palm])

        away = back.copy()
        away[:3, 3] += [0.0, -0.15, -0.1]
        return [
            Waypoint(T_world_hands=hands(before, right), duration_s=1.5, grippers=(0.0, 1.0)),
            Waypoint(T_world_hands=hands(taken, right), duration_s=1.5, grippers=(0.0, 1.0), watched=True),
            Waypoint(T_world_hands=hands(taken, right), duration_s=1.2, grippers=(0.0, 1.0), watched=True),
            Waypoint(T_world_hands=hands(taken, right), duration_s=0.8, grippers=(1.0, 1.0)),
            Waypoint(T_world_hands=hands(taken, right), duration_s=0.6, grippers=(1.0, 0.0)),
            Waypoint(T_world_hands=hands(taken, back), duration_s=1.2, grippers=(1.0, 0.0)),
            Waypoint(T_world_hands=hands(carried, away), duration_s=1.8, grippers=(1.0, 0.0)),
            Waypoint(T_world_hands=hands(carried, away), duration_s=1.6, grippers=(1.0, 0.0)),
        ]
