"""ExchangeCube: take a cube from a small table with the right gripper and pass it to the left one.

Source: the paper's "Task Settings" and "Success Conditions". Changed: the y direction is the robot's left (the
y axis of its heading), because the robot may stand on any side of the cube; the right gripper must have let go. The
table is round, so that the robot can stand on any side, and moves with the region's y and z offsets.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.scene.furniture import QUARTER_TURNS, add_cube, add_mark, add_round_table
from gym_demohlm.task import ObjectSpec, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

CUBE_EDGE, CUBE_MASS = 0.05, 0.10  # m, kg
TABLE_RADIUS, TABLE_HEIGHT = 0.12, 0.75  # m
CUBE_POSITION = (0.35, 0.0, TABLE_HEIGHT + CUBE_EDGE / 2)
MOVED = 0.3  # m to the left
DROP = 0.1  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_round_table(spec, CUBE_POSITION[:2], TABLE_RADIUS, TABLE_HEIGHT)
    add_cube(spec, "cube", CUBE_POSITION, CUBE_EDGE, CUBE_MASS, rgba=(0.20, 0.45, 0.75, 1.0))


def _build_marked(spec: mujoco.MjSpec) -> None:
    _build(spec)
    add_mark(spec, "cube", CUBE_EDGE)


def _exchanged(sim: "Worlds") -> np.ndarray:
    way = sim.pose("cube")[:, :2, 3] - sim.start_pose("cube")[:, :2, 3]
    left = poses.heading(sim.pose("pelvis"))[:, :2, 1]
    to_the_left = (way * left).sum(axis=1) > MOVED
    return to_the_left & sim.holds("left", "cube") & ~sim.holds("right", "cube")


TASK = Task(
    name="ExchangeCube",
    description="Pick up the cube with the right gripper and pass it to the left gripper.",
    hands="gripper",
    build=_build,
    objects=(ObjectSpec(name="cube", position=CUBE_POSITION, symmetry=QUARTER_TURNS),),
    wide_form=WideForm(build=_build_marked, objects=(ObjectSpec(name="cube", position=CUBE_POSITION),)),
    success=_exchanged,
    failures={"dropped": dropped("cube", DROP)},
    gaze_target="cube",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("left", "cube"), ("right", "cube")),
    episode_length_s=50.0,
)
