"""GraspCube: walk to a cube on a small round table, grasp it with the right gripper, lift it and draw it close.

Source: the paper's "Task Settings" and "Success Conditions". Changed: the height is the cube's z above the table top,
not y; x < 0.27 m is in the heading frame of the robot's pelvis; the closing gripper must press on the cube and be kept
open by it; the region's y and z offsets move the table with the cube.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.scene.furniture import QUARTER_TURNS, UNYIELDING, add_cube, add_mark, add_round_table
from gym_demohlm.task import ObjectSpec, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CUBE_EDGE = 0.06  # m
CUBE_MASS = 0.20  # kg
TABLE_RADIUS, TABLE_HEIGHT = 0.15, 0.70  # m; round, so that the robot can stand before any side of the cube
CUBE_POSITION = (0.40, 0.0, TABLE_HEIGHT + CUBE_EDGE / 2)
LIFTED = 0.1  # m, the cube's centre above the table top
NEAR = 0.27  # m, the cube ahead of the pelvis
DROP = 0.05  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_round_table(spec, CUBE_POSITION[:2], TABLE_RADIUS, TABLE_HEIGHT)
    add_cube(spec, "cube", CUBE_POSITION, CUBE_EDGE, CUBE_MASS)
    for name in ("table_top", "cube"):
        spec.geom(name).solimp[:3] = UNYIELDING


def _build_marked(spec: mujoco.MjSpec) -> None:
    _build(spec)
    add_mark(spec, "cube", CUBE_EDGE)


def _held_close(sim: "Worlds") -> np.ndarray:
    p_world_cube = sim.pose("cube")[:, :3, 3]
    lifted = p_world_cube[:, 2] > sim.pose("table")[:, 2, 3] + TABLE_HEIGHT + LIFTED
    T_base_world = poses.invert(poses.heading(sim.pose("pelvis")))
    return sim.holds("right", "cube") & lifted & (poses.transform(T_base_world, p_world_cube)[:, 0] < NEAR)


TASK = Task(
    name="GraspCube",
    description="Walk to the cube, grasp it with the right gripper and lift it off the table.",
    hands="gripper",
    build=_build,
    objects=(ObjectSpec(name="cube", position=CUBE_POSITION, symmetry=QUARTER_TURNS),),
    wide_form=WideForm(build=_build_marked, objects=(ObjectSpec(name="cube", position=CUBE_POSITION),)),
    success=_held_close,
    failures={"dropped": dropped("cube", DROP)},
    gaze_target="cube",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "cube"),),
)
