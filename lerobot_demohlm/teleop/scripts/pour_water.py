"""PourWater, scripted: the right gripper takes the bottle, brings its mouth over the bowl, tips it and rights it again.

This stands in for a person with a headset: it sends poses and gripper commands and sees no contact forces.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.02, 0.10, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: 0.39 m before bottle and bowl."""

GRIP_HEIGHT = -0.03  # m above the bottle's middle: pushed higher up, the bottle tips over
BESIDE = -0.05  # m, the hand from the bowl's middle, to the right: most of the bottle is over the bowl
POURING = -0.16  # m, while the water leaves the bottle: its mouth is 5 cm to the right, and the water flies as far left
OVER = 0.12  # m, the hand above the bowl's middle while it pours
LEVEL = -1.45  # rad: the bottle's mouth turns left; no water leaves it yet
TIPPED = -1.95  # rad: it turns down; without a wait there, in which policies would stay
LEFT_ASIDE = (0.12, 0.28, 0.74)  # m, the left palm in the base frame, clear of the table


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: pour_water", [_take, _pour])


def _aside(base: np.ndarray) -> np.ndarray:
    return base @ poses.from_rotation(np.eye(3), LEFT_ASIDE)


def _take(view: SceneView) -> list[Waypoint]:
    """Plan the way to the bottle and up."""
    base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    bottle = poses.planar(0.0, 0.0, float(poses.yaw(base)))
    bottle[:3, 3] = view.T_world_objects["bottle"][:3, 3]

    def hands(x: float, z: float) -> np.ndarray:
        return np.stack([_aside(base), bottle @ poses.from_rotation(np.eye(3), [x, 0.0, GRIP_HEIGHT + z])])

    return [
        Waypoint(T_world_hands=hands(-0.16, 0.06), duration_s=2.0),
        Waypoint(T_world_hands=hands(-0.10, 0.0), duration_s=1.0, watched=True),
        Waypoint(T_world_hands=hands(0.0, 0.0), duration_s=1.6, watched=True),
        Waypoint(T_world_hands=hands(0.0, 0.0), duration_s=1.0, watched=True),
        Waypoint(T_world_hands=hands(0.0, 0.0), duration_s=0.8, grippers=(0.0, 1.0)),
        Waypoint(T_world_hands=hands(-0.01, 0.10), duration_s=1.4, grippers=(0.0, 1.0)),
    ]


def _pour(view: SceneView) -> list[Waypoint]:
    """Plan the pouring over where the bowl is."""
    base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    bowl = poses.planar(0.0, 0.0, float(poses.yaw(base)))
    bowl[:3, 3] = view.T_world_objects["bowl"][:3, 3]

    def hands(roll: float, y: float, z: float) -> np.ndarray:
        rotation = poses.rotation_from_rpy([roll, 0.0, 0.0])
        return np.stack([_aside(base), bowl @ poses.from_rotation(rotation, [0.0, y, z])])

    closed = (0.0, 1.0)
    return [
        Waypoint(T_world_hands=hands(0.0, BESIDE - 0.05, OVER + 0.04), duration_s=1.2, grippers=closed),
        Waypoint(T_world_hands=hands(LEVEL, POURING, OVER + 0.02), duration_s=1.6, grippers=closed),
        Waypoint(T_world_hands=hands(TIPPED, POURING, OVER), duration_s=3.2, grippers=closed),
        Waypoint(T_world_hands=hands(0.0, BESIDE, OVER + 0.02), duration_s=1.8, grippers=closed),
        Waypoint(T_world_hands=hands(0.0, BESIDE, OVER + 0.02), duration_s=1.6, grippers=closed),
    ]
