"""Handover: push a cube off a small table with the right palm onto the left palm, and take it down.

Source: the paper's "Task Settings" and "Success Conditions". Changed: the paper's "button" is the cube; "lower than the
table" means wholly below its upper face. The table is round, so that the robot can stand on any side of the cube,
and moves with the region's y and z offsets.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.scene.furniture import QUARTER_TURNS, UNYIELDING, add_cube, add_mark, add_round_table
from gym_demohlm.task import ObjectSpec, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CUBE_EDGE, CUBE_MASS = 0.06, 0.4  # m, kg: of stone
TABLE_RADIUS, TABLE_HEIGHT = 0.12, 0.75  # m
CUBE_POSITION = (0.35, 0.0, TABLE_HEIGHT + CUBE_EDGE / 2)
FRICTION = (0.4, 0.005, 0.0005)  # polished stone on anything: sliding, torsional [m], rolling [m]
IN_HAND = 0.05  # m, left palm to the cube's centre
DROP = 0.3  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_round_table(spec, CUBE_POSITION[:2], TABLE_RADIUS, TABLE_HEIGHT, up_to_rim=True)
    add_cube(spec, "cube", CUBE_POSITION, CUBE_EDGE, CUBE_MASS)
    for name in ("cube", "table_top"):
        spec.geom(name).friction, spec.geom(name).solimp[:3] = FRICTION, UNYIELDING
    spec.geom("cube").priority = 2  # on rubber too: it slides onto the palm where it would stick and tip over


def _build_marked(spec: mujoco.MjSpec) -> None:
    _build(spec)
    add_mark(spec, "cube", CUBE_EDGE)


def _handed_over(sim: "Worlds") -> np.ndarray:
    top = sim.pose("cube")[:, 2, 3] + CUBE_EDGE / 2
    below = top < sim.pose("table")[:, 2, 3] + TABLE_HEIGHT
    return below & (sim.distance("left_palm", "cube") < IN_HAND)


TASK = Task(
    name="Handover",
    description="Push the cube off the table with the right hand into the left hand.",
    hands="rubber",
    build=_build,
    objects=(ObjectSpec(name="cube", position=CUBE_POSITION, symmetry=QUARTER_TURNS),),
    wide_form=WideForm(build=_build_marked, objects=(ObjectSpec(name="cube", position=CUBE_POSITION),)),
    success=_handed_over,
    failures={"dropped": dropped("cube", DROP)},
    gaze_target="cube",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("left", "cube"), ("right", "cube")),
    motion_frame="scene",
    episode_length_s=35.0,
)
