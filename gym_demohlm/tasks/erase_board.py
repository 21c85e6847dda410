"""EraseBoard: walk to a board on an easel, take the eraser from its tray and wipe the writing off to the left.

Source: the paper's "Task Settings" and "Success Conditions". Left is the board's. Mended: moving the eraser counts only
where it wiped, half of the writing or more, by pressing on the board; a board that faces away cannot be wiped, so its
yaw stays within 45 degrees; the region's offsets move board and eraser as one.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.scene import aim_overview
from gym_demohlm.scene.furniture import DARK_WOOD, STEEL, WOOD, add_picture, add_shape
from gym_demohlm.scene.lettering import write
from gym_demohlm.task import REGIONS, Memory, ObjectSpec, Task, dropped, limit_yaw

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

BOARD_POSITION = (0.45, 0.0, 0.0)  # m, the floor below the middle of the board's front; x points into the board
BOARD_HALF_SIZE = (0.010, 0.36, 0.22)  # m
TRAY_HEIGHT, TRAY_DEPTH = 0.88, 0.065  # m, of the tray's upper face, and from the board towards the robot
ERASER_SIZE = (0.050, 0.050, 0.090)  # m, stood on end; felt on the side of the board
ERASER_POSITION = (BOARD_POSITION[0] - 0.030, -0.17, TRAY_HEIGHT + ERASER_SIZE[2] / 2)
FELT_FRICTION = 0.4
WRITING_MIDDLE = (-0.010, TRAY_HEIGHT + 0.092)  # m, y and z in the board's frame
WIPING_FORCE = 1.0  # N
MOVED_DISTANCE, WIPED_SHARE = 0.2, 0.5  # m, of the writing
DROP = 0.1  # m below its start

INK = write("HELLO", (0.034, 0.062), pitch=0.047, piece_length=0.017)  # each piece is wiped as a whole
INK_START, INK_END = ((np.array(WRITING_MIDDLE) + INK[:, end] * [-1.0, 1.0]) for end in (slice(0, 2), slice(2, 4)))
"""(n, 2) y and z of each piece's ends in the board's frame [m]; seen from the robot, y points left."""


def _build(spec: mujoco.MjSpec) -> None:
    board = spec.worldbody.add_body(name="board", mocap=True, pos=BOARD_POSITION)
    aim_overview(spec, (-1.95, 1.75, 1.85), (-0.3, 0.0, 0.67), board)
    depth, width, height = BOARD_HALF_SIZE
    middle = TRAY_HEIGHT + height
    panel = board.add_body(name="panel")  # apart from the tray, so that the force on it alone is measured
    surface = add_shape(panel, "panel", "box", BOARD_HALF_SIZE, [depth, 0, middle], [0.96, 0.97, 0.98, 1])
    surface.friction[0] = FELT_FRICTION
    for side in (-1, 1):
        add_picture(board, "box", [0.014, 0.012, height], [depth, side * width, middle], STEEL)
        leg = add_shape(board, f"leg_{side}", "capsule", [0.018], rgba=DARK_WOOD)
        leg.fromto = [0.05, side * 0.20, middle + height + 0.06, 0.02, side * 0.36, -0.3]
    leg = add_shape(board, "leg_behind", "capsule", [0.018], rgba=DARK_WOOD)
    leg.fromto = [0.07, 0.0, middle + height, 0.55, 0.0, -0.3]
    add_picture(board, "box", [0.014, width + 0.012, 0.012], [depth, 0, middle + height], STEEL)
    add_shape(board, "tray", "box", [TRAY_DEPTH / 2, width, 0.008], [-TRAY_DEPTH / 2, 0, TRAY_HEIGHT - 0.008], STEEL)
    for index, (start, end) in enumerate(zip(INK_START, INK_END, strict=True)):
        piece = add_picture(panel, "capsule", [0.004], rgba=[0.10, 0.20, 0.65, 1])
        piece.name, piece.fromto = f"ink_{index}", [0.0, *start, 0.0, *end]
    eraser = spec.worldbody.add_body(name="eraser", pos=ERASER_POSITION)
    eraser.add_freejoint(name="eraser")
    x, y, z = (length / 2 for length in ERASER_SIZE)
    add_shape(eraser, "eraser_back", "box", [0.7 * x, y, z], [-0.3 * x, 0, 0], WOOD, mass=0.08)
    felt = add_shape(eraser, "eraser_felt", "box", [0.3 * x, y, z], [0.7 * x, 0, 0], [0.25, 0.25, 0.28, 1], mass=0.02)
    felt.friction[0] = FELT_FRICTION


def _wipe(sim: "Worlds", wiped: np.ndarray) -> np.ndarray:
    """Return which pieces of ink (N, n) are gone: those that have been under the felt while it pressed."""
    middles = np.insert((INK_START + INK_END) / 2, 0, 0.0, axis=1)
    T_eraser_board = poses.invert(sim.pose("eraser")) @ sim.pose("board")
    p_eraser_ink = poses.transform(T_eraser_board[:, None], middles)  # (N, n, 3)
    x, y, z = (length / 2 for length in ERASER_SIZE)
    under = (np.abs(p_eraser_ink - [x, 0.0, 0.0]) < [0.01, y, z]).all(axis=-1)
    pressing = sim.pair_force("eraser", "panel") > WIPING_FORCE
    return np.maximum(wiped, under & pressing[:, None])


def _draw(model: mujoco.MjModel, wiped: np.ndarray) -> None:
    for index, gone in enumerate(wiped):
        model.geom(f"ink_{index}").rgba[3] = 1.0 - gone


def _erased(sim: "Worlds") -> np.ndarray:
    offset = sim.pose("eraser")[:, :3, 3] - sim.start_pose("eraser")[:, :3, 3]
    moved = (offset * sim.pose("board")[:, :3, 1]).sum(axis=1) > MOVED_DISTANCE
    return moved & sim.holds("right", "eraser") & (sim.memory.mean(axis=1) >= WIPED_SHARE)


TASK = Task(
    name="EraseBoard",
    description="Walk to the board, take the eraser with the right gripper and wipe the writing off to the left.",
    hands="gripper",
    build=_build,
    objects=(
        ObjectSpec(name="eraser", position=ERASER_POSITION, moves_with="board"),
        ObjectSpec(name="board", position=BOARD_POSITION),
    ),
    success=_erased,
    failures={"dropped": dropped("eraser", DROP)},
    gaze_target="eraser",
    obstacles=("board",),
    contact_pairs=(("right", "eraser"),),
    force_pairs=(("eraser", "panel"),),
    regions=limit_yaw(REGIONS, math.pi / 4),
    motion_frame="scene",
    memory=Memory(size=len(INK), update=_wipe, draw=_draw),
)
