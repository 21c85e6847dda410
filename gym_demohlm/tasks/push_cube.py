"""PushCube: walk to a cube on a table and push it 0.1 m to the left, onto a green field, with the right hand.

Source: the paper's "Task Settings" and "Success Conditions". Left is the world's positive y, wherever the robot stands.
The robot pushes square to a face, up to 45 degrees off, so it pushes further than 0.1 m. Changed: the cube's pose
alone does not show the world's y, so a field on the table, which is tracked too, shows where the cube should go: it is
all of the table's top that lies further left than the cube's middle must come. The cube must still stand on the table,
and the right palm must have pushed it, because a blow may send it as far. The region's y and z offsets move the table
with the cube.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.scene.furniture import QUARTER_TURNS, add_cube, add_flat_picture, add_round_table
from gym_demohlm.task import Memory, ObjectSpec, Task, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CUBE_EDGE = 0.07  # m
CUBE_MASS = 0.6  # kg
CUBE_FRICTION = 0.5  # on the table; above 0.7 a push above its middle would tip it
TABLE_RADIUS, TABLE_HEIGHT = 0.22, 0.75  # m; round, so that the robot can stand before any side of the cube
CUBE_POSITION = (0.35, 0.0, TABLE_HEIGHT + CUBE_EDGE / 2)
TABLE_POSITION = (0.35, 0.07)  # under the middle of the cube's way
PUSHED_DISTANCE = 0.1  # m
PUSHED_SHARE = 0.8  # of it, with the palm on the cube
PUSHING_N = 0.5  # least force of a palm that pushes
STRUCK = 0.035  # m in a step; what is faster is struck, not pushed
FIELD_EDGE = CUBE_POSITION[1] + PUSHED_DISTANCE  # m, y of the field's straight edge, which the cube's middle must pass
FIELD_POSITION = (CUBE_POSITION[0], FIELD_EDGE + 0.08, TABLE_HEIGHT)  # the place of the field that is tracked
FIELD_HALF_HEIGHT = 0.002  # m
FIELD_RIM = 0.002  # m between the field and the table's edge
DROPPED, OVER_RIM = dropped("cube", 0.05), dropped("cube", 0.01)  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    table = add_round_table(spec, TABLE_POSITION, TABLE_RADIUS, TABLE_HEIGHT, up_to_rim=True)
    offset = [FIELD_POSITION[0] - TABLE_POSITION[0], FIELD_POSITION[1] - TABLE_POSITION[1], TABLE_HEIGHT]
    field = table.add_body(name="field", pos=offset)
    add_flat_picture(spec, field, _field_outline() - offset[:2], FIELD_HALF_HEIGHT, rgba=(0.35, 0.60, 0.35, 1.0))
    (cube,) = add_cube(spec, "cube", CUBE_POSITION, CUBE_EDGE, CUBE_MASS, rgba=(0.16, 0.42, 0.72, 1.0)).geoms
    cube.priority = 1  # its friction counts, not the table's; with the palm, which has priority too, the higher one
    cube.friction[0] = CUBE_FRICTION


def _field_outline() -> np.ndarray:
    """Return the corners (n, 2) of the table's top beyond the field's edge, in the table's frame [m]."""
    radius = TABLE_RADIUS - FIELD_RIM
    first = math.asin((FIELD_EDGE - TABLE_POSITION[1]) / radius)
    angles = np.linspace(first, math.pi - first, 33)
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _moved(sim: "Worlds") -> np.ndarray:
    """Return how far (N,) the cube is to the left of its start [m]."""
    return sim.pose("cube")[:, 1, 3] - sim.start_pose("cube")[:, 1, 3]


def _remember(sim: "Worlds", memory: np.ndarray) -> np.ndarray:
    """Return the new memory (N, 2): how far left the palm has pushed the cube, and how far left it is [m]."""
    pushed, before = memory.T
    moved = _moved(sim)
    pushing = (sim.contact_force("right", "cube") >= PUSHING_N) & (np.abs(moved - before) < STRUCK)
    return np.stack([pushed + np.where(pushing, moved - before, 0.0), moved], axis=1)


def _success(sim: "Worlds") -> np.ndarray:
    pushed = sim.memory[:, 0] > PUSHED_SHARE * PUSHED_DISTANCE
    return pushed & (_moved(sim) > PUSHED_DISTANCE) & ~OVER_RIM(sim)


TASK = Task(
    name="PushCube",
    description="Walk to the cube and push it to the left, onto the green field, with the right hand.",
    hands="rubber",
    build=_build,
    objects=(
        ObjectSpec(name="cube", position=CUBE_POSITION, symmetry=QUARTER_TURNS),
        ObjectSpec(name="field", position=FIELD_POSITION, placed=False),
    ),
    success=_success,
    failures={"dropped": DROPPED},
    gaze_target="cube",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "cube"),),
    motion_frame="scene",
    memory=Memory(size=2, update=_remember),
)
