"""OpenCabinet, scripted: the right gripper goes to the bar, closes round it, pulls it along the door's arc, holds it.

This stands in for a person with a headset; it does not touch joints, and it does not see contact forces.
"""

from collections.abc import Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.open_cabinet import CABINET_POSITION, DEPTH, HANDLE_Y, HINGE_Y, STANDOFF
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

STANCE, SIDE = 0.53, 0.06  # m that the handle is ahead of the pelvis, and to its right
_HANDLE_X = CABINET_POSITION[0] - DEPTH / 2 - STANDOFF
START: InitialState = {"robot": [_HANDLE_X - STANCE, HANDLE_Y + SIDE, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the handle before its right shoulder."""

RAISED = (0.24, -0.20)  # m, ahead of and beside the pelvis, at the handle's height
BACK = 0.10  # m before the bar: where the open fingers line up
OPEN_ANGLE = 0.68  # rad that the door is pulled
PULLS = 6  # waypoints on the arc
CLOSED = (0.0, 1.0)


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: open_cabinet", [_reach_and_pull])


def _reach_and_pull(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way to the handle and the arc round the hinge in the cabinet's frame."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_handle, T_world_cabinet = view.T_world_objects["handle"], view.T_world_objects["cabinet"]

    def hands(T_world_right: np.ndarray) -> np.ndarray:
        return np.stack([view.T_world_hands[0], T_world_right])

    raised = T_world_base @ poses.pose([*RAISED, float(T_world_handle[2, 3])])
    before = T_world_handle @ poses.pose([-BACK, 0.0, 0.0])
    T_world_hinge = T_world_cabinet @ poses.pose([-DEPTH / 2, HINGE_Y, 0.0])
    T_hinge_handle = poses.invert(T_world_hinge) @ T_world_handle

    def pulled(angle: float) -> np.ndarray:
        return hands(T_world_hinge @ poses.planar(0.0, 0.0, angle) @ T_hinge_handle)

    angles = OPEN_ANGLE * (np.arange(PULLS) + 1) / PULLS
    return [
        Waypoint(T_world_hands=hands(raised), duration_s=1.4),
        Waypoint(T_world_hands=hands(before), duration_s=1.2),
        Waypoint(T_world_hands=pulled(0.0), duration_s=1.2),
        Waypoint(T_world_hands=pulled(0.0), duration_s=0.5),
        Waypoint(T_world_hands=pulled(0.0), duration_s=0.9, grippers=CLOSED),
        *(Waypoint(T_world_hands=pulled(angle), duration_s=0.6, grippers=CLOSED) for angle in angles),
        Waypoint(T_world_hands=pulled(OPEN_ANGLE), duration_s=1.6, grippers=CLOSED),
    ]
