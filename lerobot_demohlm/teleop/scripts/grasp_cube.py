"""GraspCube, scripted: the right gripper comes down on the cube at a slant, closes, lifts it and draws it close.

This stands in for a person with a headset; it does not touch joints, and it does not see contact forces.
"""

import math
from collections.abc import Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.grasp_cube import CUBE_POSITION
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

STANCE, SIDE = 0.43, 0.15  # m that the cube is ahead of the pelvis, and to its right
START: InitialState = {"robot": [CUBE_POSITION[0] - STANCE, CUBE_POSITION[1] + SIDE, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the table's rim stays clear of its body."""

TILT = 0.55  # rad, fingers down
GRIP_HEIGHT = 0.035  # m above the cube's centre: the finger tips stay clear of the table
BACK, ABOVE = 0.10, 0.10  # m, how far back and above the gripper waits
HELD = (0.16, -0.12, 0.13)  # m, ahead of and beside the pelvis, and above where the cube was
HELD_TILT, HELD_YAW = 0.1, 0.6  # rad: the forearm across the chest
RAISED = (
    0.18,
    -0.26,
    0.10,
)  # m, ahead of and beside the pelvis, and above the cube: clear of the table's rim
CLOSED = (0.0, 1.0)


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: grasp_cube", [_grasp_and_lift])


def _grasp_and_lift(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way to the cube in the cube's frame, turned to the robot, and the way back in the robot's."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_cube = view.T_world_objects["cube"] @ _nearest_face(view.T_world_objects["cube"], T_world_base)

    def hands(T_world_frame: np.ndarray, position: Sequence[float], tilt: float, yaw: float = 0.0) -> np.ndarray:
        right = poses.from_rotation(poses.rotation_from_rpy([0.0, tilt, yaw]), position)
        return np.stack([view.T_world_hands[0], T_world_frame @ right])

    height = float(T_world_cube[2, 3]) + GRIP_HEIGHT
    raised = hands(T_world_base, [*RAISED[:2], height + RAISED[2]], 0.3 * TILT)
    above = hands(T_world_cube, [-BACK, 0.0, GRIP_HEIGHT + ABOVE], TILT)
    around = hands(T_world_cube, [0.0, 0.0, GRIP_HEIGHT], TILT)
    lifted = hands(T_world_cube, [-0.04, 0.0, GRIP_HEIGHT + 0.12], TILT)
    held = hands(T_world_base, [*HELD[:2], height + HELD[2]], HELD_TILT, HELD_YAW)
    return [
        Waypoint(T_world_hands=raised, duration_s=1.4),
        Waypoint(T_world_hands=above, duration_s=1.2),
        Waypoint(T_world_hands=around, duration_s=1.8),
        Waypoint(T_world_hands=around, duration_s=0.6),
        Waypoint(T_world_hands=around, duration_s=0.8, grippers=CLOSED),
        Waypoint(T_world_hands=lifted, duration_s=1.2, grippers=CLOSED),
        Waypoint(T_world_hands=held, duration_s=1.6, grippers=CLOSED),
        Waypoint(T_world_hands=held, duration_s=1.6, grippers=CLOSED),
    ]


def _nearest_face(T_world_cube: np.ndarray, T_world_base: np.ndarray) -> np.ndarray:
    """Return the turn of the cube about its vertical after which it faces most as the robot does."""
    yaw = float(poses.wrap_angle(poses.yaw(T_world_base) - poses.yaw(T_world_cube)))
    quarter = math.pi / 2
    return poses.planar(0.0, 0.0, quarter * round(yaw / quarter))
