"""OpenCabinet: walk to a cabinet, grip the bar handle of its door with the right gripper and pull the door open.

Source: the paper's "Task Settings" and "Success Conditions": the right gripper is closed, round the handle, and the
handle has moved by more than 0.2 m. Mended: yaw is limited to +-45 degrees, as a door cannot be opened from behind; the
region's z offset lowers the whole cabinet, whose base goes into the floor.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import ROBOT_BIT
from gym_demohlm.scene import aim_overview
from gym_demohlm.scene.furniture import DARK_WOOD, STEEL, WOOD, add_picture, add_shape
from gym_demohlm.task import REGIONS, ObjectSpec, Task, limit_yaw

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

DEPTH, WIDTH, HEIGHT, BASE = 0.34, 0.42, 1.10, 0.45  # m; the door begins where the base ends
BOARD = 0.012  # m, half the thickness of its boards
CABINET_POSITION = (0.75, 0.0, 0.0)
HANDLE_HEIGHT, HANDLE_LENGTH, HANDLE_RADIUS = 0.80, 0.20, 0.009  # m
STANDOFF = 0.055  # m, from the door's face to the middle of the bar
HINGE_Y, HANDLE_Y = -WIDTH / 2, WIDTH / 2 - 0.06  # m, the door hangs on its right side
DOOR_MASS = 1.5  # kg
OPENED = 0.2  # m that the handle has moved
_WHITE, _INSIDE, _RED, _BLUE = (0.88, 0.87, 0.84, 1), (0.60, 0.48, 0.36, 1), (0.75, 0.25, 0.2, 1), (0.2, 0.4, 0.65, 1)


def _build(spec: mujoco.MjSpec) -> None:
    cabinet = spec.worldbody.add_body(name="cabinet", mocap=True, pos=CABINET_POSITION)
    aim_overview(spec, (-1.75, 2.2, 1.7), (-0.4, 0.05, 0.63), cabinet)
    carcass = cabinet.add_body(name="carcass")
    front, middle = -DEPTH / 2, (HEIGHT + BASE) / 2
    tall = (HEIGHT - BASE) / 2
    for name, half_size, position, rgba in (
        ("base", [DEPTH / 2, WIDTH / 2, BASE / 2], [0, 0, BASE / 2], DARK_WOOD),
        ("top", [DEPTH / 2, WIDTH / 2, BOARD], [0, 0, HEIGHT - BOARD], WOOD),
        ("back", [BOARD, WIDTH / 2, tall], [DEPTH / 2 - BOARD, 0, middle], _INSIDE),
        ("left", [DEPTH / 2, BOARD, tall], [0, WIDTH / 2 - BOARD, middle], WOOD),
        ("right", [DEPTH / 2, BOARD, tall], [0, BOARD - WIDTH / 2, middle], WOOD),
        ("shelf", [DEPTH / 2 - 0.03, WIDTH / 2 - BOARD, BOARD], [0.02, 0, middle], _INSIDE),
    ):
        board = add_shape(carcass, f"carcass_{name}", "box", half_size, position, rgba)
        board.contype, board.conaffinity = 0, ROBOT_BIT
    add_picture(carcass, "cylinder", [0.045, 0.06], [0.02, -0.06, middle + BOARD + 0.06], _RED)
    add_picture(carcass, "box", [0.05, 0.06, 0.08], [0.02, 0.08, BASE + 0.08], _BLUE)

    door = cabinet.add_body(name="door", pos=[front, HINGE_Y, middle])
    hinge = door.add_joint(name="door_hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [0, 1.9]  # rad
    hinge.damping[0], hinge.frictionloss, hinge.armature = 1.0, 0.3, 0.01  # Nms/rad, Nm, kg m^2
    leaf = door.add_body(name="leaf", pos=[-BOARD - 0.002, WIDTH / 2, 0])
    panel = add_shape(leaf, "leaf", "box", [BOARD, WIDTH / 2, tall], rgba=_WHITE, mass=DOOR_MASS)
    handle = door.add_body(name="handle", pos=[-2 * BOARD - STANDOFF, HANDLE_Y - HINGE_Y, HANDLE_HEIGHT - middle])
    bar = add_shape(handle, "handle", "capsule", [HANDLE_RADIUS, HANDLE_LENGTH / 2], rgba=STEEL, mass=0.1)
    for geom in (panel, bar):
        geom.contype, geom.conaffinity = 0, ROBOT_BIT
    for end in (-1, 1):
        add_picture(handle, "box", [STANDOFF / 2, 0.006, 0.006], [STANDOFF / 2, 0, end * HANDLE_LENGTH / 2], STEEL)


def _opened(sim: "Worlds") -> np.ndarray:
    moved = sim.pose("handle")[:, :3, 3] - sim.start_pose("handle")[:, :3, 3]
    return sim.holds("right", "handle") & (np.sqrt((moved**2).sum(axis=1)) > OPENED)


TASK = Task(
    name="OpenCabinet",
    description="Walk to the cabinet and pull its door open by the handle with the right gripper.",
    hands="gripper",
    build=_build,
    objects=(
        ObjectSpec(name="handle", position=(0.0, 0.0, HANDLE_HEIGHT), placed=False),
        ObjectSpec(name="cabinet", position=CABINET_POSITION),
    ),
    success=_opened,
    gaze_target="handle",
    obstacles=("carcass", "leaf"),
    contact_pairs=(("right", "handle"),),
    regions=limit_yaw(REGIONS, math.pi / 4),
    motion_frame="scene",
)
