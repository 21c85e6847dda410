"""StackCube, scripted: the right gripper takes the red cube at a slant, lifts it over the blue one and lets it go.

This stands in for a person with a headset; it does not touch joints, and it does not see contact forces.
"""

from collections.abc import Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.stack_cube import STACKED
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.06, 0.13, 0.0], "object": [0.0, 0.0, 0.0]}
"""Where the robot stands when the operator takes over: far enough from the table for its arms to rise, and so far left
that the right upper arm stays clear of the trunk."""
TILT = 0.3  # rad, fingers down
GRIP = (-0.005, 0.0, 0.010)  # m, the palm from the cube's centre: the finger tips stay clear of what is below the cube
ABOVE_BLUE = 0.006  # m, the red cube is let go at this height above the blue one
CLEAR = 0.08  # m above the blue cube on the way there
BESIDE = (0.16, -0.26)  # m, the right palm from the pelvis while it goes up past the table's rim
LEFT_ASIDE = (0.20, 0.28, 0.72)  # m, the left palm in the base frame, clear of the table
OPEN, CLOSED = (0.0, 0.0), (0.0, 1.0)


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: stack_cube", [_take, _stack])


def _take(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way to the red cube and up."""
    centre, pelvis = view.T_world_objects["red"][:3, 3], view.T_world_pelvis[:3, 3]

    def go(x: float, z: float, seconds: float, grippers: tuple[float, float] = OPEN, watched: bool = False) -> Waypoint:
        return _waypoint(view, centre + np.array(GRIP) + [x, 0.0, z], seconds, grippers, watched)

    beside = np.array([pelvis[0] + BESIDE[0], pelvis[1] + BESIDE[1], centre[2] + 0.10])
    return [
        _waypoint(view, beside, 1.4, OPEN, False),
        go(-0.13, 0.10, 1.2),
        go(-0.10, 0.03, 1.0, watched=True),
        go(0.0, 0.0, 1.4, watched=True),
        go(0.0, 0.0, 0.4, watched=True),
        go(0.0, 0.0, 0.6, CLOSED),
        go(-0.01, STACKED + CLEAR, 1.6, CLOSED),
    ]


def _stack(view: SceneView) -> Sequence[Waypoint]:
    """Plan the way over the blue cube and down, letting go, and the way back; the red cube is in the hand."""
    held = view.T_world_objects["red"][:3, 3] - view.T_world_hands[1][:3, 3]
    centre = view.T_world_objects["blue"][:3, 3] + [0.0, 0.0, STACKED + ABOVE_BLUE] - held

    def go(x: float, z: float, seconds: float, grippers: tuple[float, float] = OPEN) -> Waypoint:
        return _waypoint(view, centre + np.array([x, 0.0, z]), seconds, grippers, grippers == CLOSED)

    return [
        go(0.0, CLEAR, 1.6, CLOSED),
        go(0.0, CLEAR, 0.4, CLOSED),
        go(0.0, 0.0, 1.6, CLOSED),
        go(0.0, 0.0, 0.4, CLOSED),
        go(0.0, 0.0, 0.8),
        go(-0.13, 0.04, 1.6),
        go(-0.13, 0.04, 1.6),
    ]


def _waypoint(
    view: SceneView, palm: np.ndarray, seconds: float, grippers: tuple[float, float], watched: bool
) -> Waypoint:
    """Return a waypoint for the right palm (3,) [m, world]; the left one waits aside."""
    base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    left = base @ poses.from_rotation(np.eye(3), LEFT_ASIDE)
    right = poses.from_rotation(poses.rotation_from_rpy([0.0, TILT, 0.0]), palm)
    return Waypoint(T_world_hands=np.stack([left, right]), duration_s=seconds, grippers=grippers, watched=watched)
