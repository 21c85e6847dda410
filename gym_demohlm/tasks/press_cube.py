"""PressCube: walk to a small cube on a table and press on it with the right hand.

Source: the paper's "Task Settings" and "Success Conditions", whose "button" is the cube. Changed: the hand must also
press, because nearness alone would count a hovering hand; the region's y and z offsets move the table with the cube.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.scene.furniture import QUARTER_TURNS, add_cube, add_mark, add_round_table
from gym_demohlm.task import ObjectSpec, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CUBE_EDGE = 0.06  # m
CUBE_MASS = 0.15  # kg
TABLE_RADIUS, TABLE_HEIGHT = 0.16, 0.75  # m; round, so that the robot can stand before any side of the cube
CUBE_POSITION = (0.35, 0.0, TABLE_HEIGHT + CUBE_EDGE / 2)
PRESS_DISTANCE = 0.05  # m, right palm to the cube's centre
PRESS_FORCE = 1.0  # N
DROP = 0.05  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_round_table(spec, CUBE_POSITION[:2], TABLE_RADIUS, TABLE_HEIGHT)
    add_cube(spec, "cube", CUBE_POSITION, CUBE_EDGE, CUBE_MASS)


def _build_marked(spec: mujoco.MjSpec) -> None:
    _build(spec)
    add_mark(spec, "cube", CUBE_EDGE)


def _pressed(sim: "Worlds") -> np.ndarray:
    near = sim.distance("right_palm", "cube") < PRESS_DISTANCE
    return near & (sim.contact_force("right", "cube") > PRESS_FORCE)


TASK = Task(
    name="PressCube",
    description="Walk to the cube and press on it with the right hand.",
    hands="rubber",
    build=_build,
    objects=(ObjectSpec(name="cube", position=CUBE_POSITION, symmetry=QUARTER_TURNS),),
    wide_form=WideForm(build=_build_marked, objects=(ObjectSpec(name="cube", position=CUBE_POSITION),)),
    success=_pressed,
    failures={"dropped": dropped("cube", DROP)},
    gaze_target="cube",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "cube"),),
    motion_frame="hands",
)
