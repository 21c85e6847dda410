"""EraseBoard, scripted: the right gripper around the eraser, close, lift, press it on the board, wipe left, and again.

The second time is for robots that were pushed away from the board the first time. Where worlds vary, and in rollouts,
whoever succeeds at first is done; in plain worlds attempts repeat all of it.
This stands in for a person with a headset. It sends poses through the same path (inverse kinematics, command,
controller, physics); it does not touch joints, and it does not see contact forces.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import InitialState
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import PathOperator, Waypoint

START: InitialState = {"robot": [-0.06, 0.05, 0.0], "object": [0.0, -0.08, 0.0]}
"""Where the robot stands when the operator takes over: the eraser before its right arm, the writing further left."""

RAISED = (0.16, -0.22, 0.86)  # m, ahead of the pelvis, to its left, above the floor
BEFORE = 0.12  # m, gripper before the eraser on the way to it
GRIP = -0.027  # m, middle of the pads from the eraser's middle; pressed, it slips 8 mm in, the tips still off the board
LIFT = 0.06  # m, from the tray to the writing
TO_BOARD = 0.005  # m, from the felt to the board
PRESS = (0.005, 0.012)  # m, how far inside the board the felt is asked to be, first and last: the arm gives way
WIPE = 0.27  # m
SEEN_S = 1.4  # s, between the two: a success has to last a second
STILL_S, SHORTLY_S = 1.5, 0.5  # s, at the end; who is shown that it has succeeded needs no longer
OPEN, CLOSED = (0.0, 0.0), (0.0, 1.0)


def make_operator() -> PathOperator:
    """Return the operator of this task."""
    return PathOperator("scripted: erase_board", [_plan])


def _plan(view: SceneView) -> list[Waypoint]:
    """Plan the gripper's way in the frame of the eraser as it stands on the tray; the left hand stays where it is."""
    left = view.T_world_hands[0]
    T_world_base = poses.planar(*poses.to_planar(view.T_world_pelvis))
    T_world_eraser = poses.heading(view.T_world_objects["eraser"])
    raised = np.stack([left, T_world_base @ poses.pose(RAISED)])

    def hands(forward: float, leftward: float = 0.0, up: float = 0.0) -> np.ndarray:
        return np.stack([left, T_world_eraser @ poses.pose([GRIP + forward, leftward, up])])

    still_s = STILL_S if view.T_world_targets is None else SHORTLY_S
    pressed, kept = (TO_BOARD + press for press in PRESS)
    return [
        Waypoint(T_world_hands=raised, duration_s=1.4),
        Waypoint(T_world_hands=hands(-BEFORE), duration_s=1.2),
        Waypoint(T_world_hands=hands(0.0), duration_s=1.4),
        Waypoint(T_world_hands=hands(0.0), duration_s=0.8, grippers=CLOSED, settled=True),
        Waypoint(T_world_hands=hands(-0.01, up=LIFT), duration_s=1.0, grippers=CLOSED),
        Waypoint(T_world_hands=hands(pressed, up=LIFT), duration_s=0.8, grippers=CLOSED),
        Waypoint(T_world_hands=hands(kept, WIPE, LIFT), duration_s=2.6, grippers=CLOSED),
        Waypoint(T_world_hands=hands(kept, WIPE, LIFT), duration_s=SEEN_S, grippers=CLOSED),
        Waypoint(T_world_hands=hands(pressed, up=LIFT), duration_s=2.2, grippers=CLOSED),
        Waypoint(T_world_hands=hands(kept, WIPE, LIFT), duration_s=2.6, grippers=CLOSED),
        Waypoint(T_world_hands=hands(kept, WIPE, LIFT), duration_s=still_s, grippers=CLOSED),
    ]
