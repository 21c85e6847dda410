"""Handover, scripted: left palm upwards below the table's edge, the right palm pushes the cube onto it, both go down.

The right hand comes from the robot's side along the cube's face, so that it moves aside what stands beside the cube.

This stands in for a person with a headset: it sends poses of the palms and sees no contact forces.
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.handover import CUBE_EDGE, TABLE_RADIUS
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.05, 0.13, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: 0.40 m before the cube, left of it so that the right upper arm
stays clear of the trunk."""

BELOW = 0.005  # m below the table's upper face: where the left palm waits
WAIT_Y = TABLE_RADIUS + 0.044  # m, left of the cube: the palm's near edge is beside the table's
PUSH_Z = 0.032  # m above the cube's centre: the palm stays clear of the table
BACK_PITCH = 0.25  # rad: the right hand's fingers down
CRADLE, LEFT_PITCH = 0.03, -0.08  # rad: the left palm towards the table, its fingers up
BESIDE_X = -0.09  # m, from the cube's middle towards the robot: where the right palm comes down
BESIDE_Y = 0.03  # m, from the cube's face to the right palm as it comes in along it
PUSHED = 0.02  # m past the table's edge
AWAY = (0.0, 0.05, 0.0)  # m, how the left palm moves with the cube: first aside,
TAKEN = (-0.03, 0.07, -0.12)  # m, then down


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: handover", [_plan])


def _plan(view: SceneView) -> list[Waypoint]:
    """Plan everything in the cube's frame, turned to the robot."""
    T = view.T_world_objects["cube"]
    yaw = float(poses.wrap_angle(poses.yaw(view.T_world_pelvis) - poses.yaw(T)))
    T = T @ poses.planar(0.0, 0.0, math.pi / 2 * round(yaw / (math.pi / 2)))
    palm_up = poses.rotation_from_rpy([CRADLE - math.pi / 2, LEFT_PITCH, 0.0])
    pushing = poses.rotation_from_rpy([0.0, BACK_PITCH, 0.0])
    top = -CUBE_EDGE / 2

    def hands(left: tuple[float, float, float], right: tuple[float, float, float]) -> np.ndarray:
        return T @ np.stack([poses.from_rotation(palm_up, left), poses.from_rotation(pushing, right)])

    start_y, end_y = -CUBE_EDGE / 2, TABLE_RADIUS + PUSHED
    wait = (0.0, WAIT_Y, top - BELOW)
    aside = (wait[0], wait[1] + 0.12, wait[2])
    away, taken = (tuple(np.add(wait, way)) for way in (AWAY, TAKEN))
    return [
        Waypoint(T_world_hands=hands(aside, (-0.10, start_y - 0.07, PUSH_Z + 0.12)), duration_s=1.5),
        Waypoint(T_world_hands=hands(wait, (BESIDE_X, start_y - BESIDE_Y, PUSH_Z)), duration_s=1.0, watched=True),
        Waypoint(T_world_hands=hands(wait, (0.0, start_y - BESIDE_Y, PUSH_Z)), duration_s=1.5, watched=True),
        Waypoint(T_world_hands=hands(wait, (0.0, start_y - 0.01, PUSH_Z)), duration_s=1.0, watched=True),
        Waypoint(T_world_hands=hands(wait, (0.0, end_y, PUSH_Z)), duration_s=2.6),
        Waypoint(T_world_hands=hands(wait, (0.0, end_y, PUSH_Z)), duration_s=0.4),
        Waypoint(T_world_hands=hands(wait, (-0.02, end_y - 0.08, PUSH_Z + 0.02)), duration_s=0.8),
        Waypoint(T_world_hands=hands(away, (-0.04, start_y - 0.06, PUSH_Z + 0.06)), duration_s=1.0),
        Waypoint(T_world_hands=hands(taken, (-0.06, start_y - 0.12, PUSH_Z)), duration_s=1.5),
        Waypoint(T_world_hands=hands(taken, (-0.06, start_y - 0.12, PUSH_Z)), duration_s=2.2),
    ]
