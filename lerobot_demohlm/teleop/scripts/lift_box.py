"""LiftBox, scripted: both palms beside the box, squeeze 2 cm into it, lift it close to the body, hold it.

This stands in for a person with a headset. It sends the same poses through the same path (inverse kinematics,
command, controller, physics); it does not touch joints, and it does not see contact forces.
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.lift_box import BOX_SIZE
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.08, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the knees of a squat just stay clear of the box."""

SQUEEZE = 0.02  # m, how far inside the box's sides the palms are asked to be
CLEARANCE = 0.07  # m, beside the box before the squeeze
GRIP_HEIGHT = 0.05  # m above the box's centre: it hangs stably, and the robot need not bend so low
GRIP_NEAR = 0.03  # m from the box's centre towards the robot
REACH_TILT, HOLD_TILT = 0.75, 0.5  # rad, fingers down; the box tilts towards the robot by the difference
LIFTED_HEIGHT = 0.86  # m, the box's centre: 0.57 m above its start, enough for the lowest start too
LIFTED_DISTANCE = 0.36  # m, pelvis (before the squat) to the box's centre, ahead


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: lift_box", [_plan])


def _plan(view: SceneView) -> list[Waypoint]:
    """Plan the way to the box in the box's frame, turned to the robot, and the way up in the robot's."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_box = view.T_world_objects["box"] @ _nearest_face(view.T_world_objects["box"], T_world_base)

    def hands(T_world_frame: np.ndarray, x: float, half_gap: float, z: float, tilt: float) -> np.ndarray:
        rotation = poses.rotation_from_rpy([0.0, tilt, 0.0])
        return T_world_frame @ poses.from_rotation(rotation, [[x, half_gap, z], [x, -half_gap, z]])

    half_width = BOX_SIZE[1] / 2
    beside, grip = half_width + CLEARANCE, half_width - SQUEEZE
    above = hands(T_world_box, -GRIP_NEAR - 0.06, beside + 0.04, GRIP_HEIGHT + 0.22, 0.6 * REACH_TILT)
    around = hands(T_world_box, -GRIP_NEAR, beside, GRIP_HEIGHT, REACH_TILT)
    gripped = hands(T_world_box, -GRIP_NEAR, grip, GRIP_HEIGHT, REACH_TILT)
    lifted = hands(T_world_base, LIFTED_DISTANCE - GRIP_NEAR, grip, LIFTED_HEIGHT + GRIP_HEIGHT, HOLD_TILT)
    return [
        Waypoint(T_world_hands=above, duration_s=1.2),
        Waypoint(T_world_hands=around, duration_s=1.3),
        Waypoint(T_world_hands=gripped, duration_s=0.8),
        Waypoint(T_world_hands=gripped, duration_s=0.3),
        Waypoint(T_world_hands=lifted, duration_s=2.8),
        Waypoint(T_world_hands=lifted, duration_s=1.6),
    ]


def _nearest_face(T_world_box: np.ndarray, T_world_base: np.ndarray) -> np.ndarray:
    """Return the turn of the box about its vertical after which it faces most as the robot does."""
    yaw = float(poses.wrap_angle(poses.yaw(T_world_base) - poses.yaw(T_world_box)))
    quarter = math.pi / 2
    return poses.planar(0.0, 0.0, quarter * round(yaw / quarter))
