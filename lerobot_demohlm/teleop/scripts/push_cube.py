"""PushCube, scripted: the right palm beside the cube, then straight to the left with the cube before it, and back off.

The hand comes from the robot's side along the cube's face, so that it moves aside what stands beside the cube.

This stands in for a person with a headset. It sends poses through the same path (inverse kinematics, command,
controller, physics); it does not touch joints, and it does not see contact forces.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.push_cube import CUBE_EDGE
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.14, 0.14, 0.0], "object": [0.0, -0.08, 0.0]}
"""Where the robot stands when the operator takes over: the cube's way passes before its right shoulder."""

RAISED = (0.12, -0.28, 0.95)  # m, ahead of the pelvis, to its left, above the floor: clear of the table's edge
BESIDE = 0.07  # m, palm beside the cube on the way to it
BESIDE_X = -0.13  # m, from the cube's middle towards the robot: where the palm comes down
ALONG = 0.03  # m, from the cube's face to the palm as it comes in along it
HEIGHT = 0.015  # m, palm above the cube's middle: its lower edge stays clear of the table
PUSH = 0.20  # m
LEAD = 0.025  # m further ahead at the end: an arm that reaches across trails behind what it is asked


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: push_cube", [_plan])


def _plan(view: SceneView) -> list[Waypoint]:
    """Plan the right hand's way in the robot's heading, from the cube's place; the left hand stays where it is."""
    left = view.T_world_hands[0]
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    raised = T_world_base @ poses.pose(RAISED)
    T_world_start = T_world_base.copy()
    T_world_start[:3, 3] = view.T_world_objects["cube"][:3, 3]

    def hands(left_of_start: float, height: float = HEIGHT, ahead: float = 0.0) -> np.ndarray:
        return np.stack([left, T_world_start @ poses.pose([ahead, left_of_start - CUBE_EDGE / 2, height])])

    return [
        Waypoint(T_world_hands=np.stack([left, raised]), duration_s=1.4),
        Waypoint(T_world_hands=hands(-BESIDE, 0.1, BESIDE_X), duration_s=1.4),
        Waypoint(T_world_hands=hands(-ALONG, ahead=BESIDE_X), duration_s=0.8),
        Waypoint(T_world_hands=hands(-ALONG), duration_s=1.0),
        Waypoint(T_world_hands=hands(PUSH, ahead=LEAD), duration_s=2.4),
        Waypoint(T_world_hands=hands(PUSH, ahead=LEAD), duration_s=0.4),
        Waypoint(T_world_hands=hands(PUSH - BESIDE), duration_s=0.8),
        Waypoint(T_world_hands=hands(PUSH - BESIDE), duration_s=0.6),
    ]
