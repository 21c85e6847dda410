"""PressCube, scripted: the right palm turns down over the cube, comes down on it, presses on it, stays.

This stands in for a person with a headset. It sends poses through the same path (inverse kinematics, command,
controller, physics); it does not touch joints, and it does not see contact forces.
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.press_cube import CUBE_EDGE
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.10, 0.12, 0.0], "object": [0.0, -0.08, 0.0]}
"""Where the robot stands when the operator takes over: the cube before its right shoulder."""

RAISED = (0.12, -0.24, 0.95)  # m, ahead of the pelvis, to its left, above the floor: clear of the table's edge
ABOVE, OVER = 0.12, 0.06  # m, palm over the cube's top on the way to it
PRESS = 0.018  # m, how far below the cube's top the palm is asked to be
FINGERS_IN = 0.25  # rad, the right hand turned to the left, as a forearm that reaches inwards has it


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: press_cube", [_plan])


def _plan(view: SceneView) -> list[Waypoint]:
    """Plan the right hand's way in the robot's heading, above the cube; the left hand stays where it is."""
    left = view.T_world_hands[0]
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    palm_down = T_world_base[:3, :3] @ poses.rotation_from_rpy([-math.pi / 2, 0.0, FINGERS_IN])
    top = view.T_world_objects["cube"][:3, 3] + np.array([0.0, 0.0, CUBE_EDGE / 2])

    def hands(height: float) -> np.ndarray:
        return np.stack([left, poses.from_rotation(palm_down, top + np.array([0.0, 0.0, height]))])

    half_down = T_world_base[:3, :3] @ poses.rotation_from_rpy([-math.pi / 4, -0.5, 0.0])
    raised = np.stack([left, poses.from_rotation(half_down, poses.transform(T_world_base, np.array(RAISED)))])
    return [
        Waypoint(T_world_hands=raised, duration_s=1.4),
        Waypoint(T_world_hands=hands(ABOVE), duration_s=1.2),
        Waypoint(T_world_hands=hands(OVER), duration_s=0.8),
        Waypoint(T_world_hands=hands(-PRESS), duration_s=1.0),
        Waypoint(T_world_hands=hands(-PRESS), duration_s=1.8),
    ]
