"""LiftBox, scripted: both palms beside the box, squeeze 2 cm into it, lift it close to the body, hold it.

This stands in for a person with a headset. It sends the same poses through the same path (inverse kinematics,
command, controller, physics); it does not touch joints, and it does not see contact forces.
"""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.lift_box import BOX_SIZE
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView
from lerobot_demohlm.teleop.path import HandPath, Waypoint

START: InitialState = {"robot": [-0.04, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: the box's centre 0.39 m ahead of the pelvis, clear of the knees."""

SQUEEZE = 0.02  # m, how far inside the box's sides the palms are asked to be
CLEARANCE = 0.07  # m, beside the box before the squeeze
GRIP_HEIGHT = 0.04  # m above the box's centre: it hangs stably, and the robot need not bend so low
REACH_TILT, HOLD_TILT = 0.75, 0.5  # rad, fingers down; the box tilts towards the robot by the difference
LIFTED_HEIGHT = 0.82  # m, the box's centre: 0.53 m above its start, enough for lower starts too
LIFTED_DISTANCE = 0.33  # m, pelvis (before the squat) to the box's centre, ahead


class LiftBoxOperator:
    """The scripted operator."""

    name = "scripted: lift_box"

    def __init__(self) -> None:
        self._path: HandPath | None = None

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick, planned at the first one from where things are then."""
        if self._path is None:
            self._path = _plan(view)
        if view.tick >= len(self._path):
            return None
        return OperatorPoses(
            T_world_head=view.T_world_head,
            T_world_hands=self._path.T_world_hands[view.tick],
            grippers=self._path.grippers[view.tick],
        )


def make_operator() -> LiftBoxOperator:
    """Return the operator of this task."""
    return LiftBoxOperator()


def _plan(view: SceneView) -> HandPath:
    """Plan in the robot's heading frame, which the box is square with."""
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    box = poses.transform(poses.invert(T_world_base), view.T_world_objects["box"][:3, 3])
    half_width = BOX_SIZE[1] / 2

    def hands(x: float, half_gap: float, z: float, tilt: float) -> np.ndarray:
        rotation = poses.rotation_from_rpy([0.0, tilt, 0.0])
        return T_world_base @ poses.from_rotation(rotation, [[x, half_gap, z], [x, -half_gap, z]])

    x, z = float(box[0]), float(box[2]) + GRIP_HEIGHT
    beside, grip = half_width + CLEARANCE, half_width - SQUEEZE
    lifted = hands(LIFTED_DISTANCE, grip, LIFTED_HEIGHT + GRIP_HEIGHT, HOLD_TILT)
    waypoints = [
        Waypoint(T_world_hands=hands(x - 0.06, beside + 0.04, z + 0.22, 0.6 * REACH_TILT), duration_s=1.2),
        Waypoint(T_world_hands=hands(x, beside, z, REACH_TILT), duration_s=1.3),
        Waypoint(T_world_hands=hands(x, grip, z, REACH_TILT), duration_s=0.8),
        Waypoint(T_world_hands=hands(x, grip, z, REACH_TILT), duration_s=0.3),
        Waypoint(T_world_hands=lifted, duration_s=2.8),
        Waypoint(T_world_hands=lifted, duration_s=1.6),
    ]
    return HandPath(view.T_world_hands, waypoints)


assert math.isclose(BOX_SIZE[0], BOX_SIZE[1])  # square in plan: four equal faces to stand before
