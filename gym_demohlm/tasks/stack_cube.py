"""StackCube: walk to a table, take the red cube with the right gripper and set it on the blue cube.

Not in the paper. The two cubes are placed independently of each other, in position and in yaw, so that no motion that
is about one of them alone can do it: the hand first follows the red cube, then, holding it, the blue one.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.scene.furniture import QUARTER_TURNS, add_cube, add_round_table
from gym_demohlm.task import Goal, ObjectSpec, Spread, Task

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

TABLE_POSITION, TABLE_RADIUS, TABLE_HEIGHT = (0.35, -0.02), 0.19, 0.75  # m
RED_EDGE, RED_MASS = 0.05, 0.10  # m, kg
BLUE_EDGE, BLUE_MASS = 0.06, 0.25  # m, kg
GAP = 1e-4  # m, above the table: faces exactly in one plane can give MuJoCo's collider a false depth
RED_POSITION = (0.35, -0.115, TABLE_HEIGHT + RED_EDGE / 2 + GAP)
BLUE_POSITION = (0.35, 0.04, TABLE_HEIGHT + BLUE_EDGE / 2 + GAP)
STACKED = (RED_EDGE + BLUE_EDGE) / 2  # m, the red cube's centre above the blue one's
LEVEL = 0.012  # m, how well that height must fit; cubes of other sizes do
OVER = 0.025  # m, the red cube's centre from the blue one's seen from above
RESTING_N = 0.3 * RED_MASS * 9.81  # N, of the red cube on the blue one
DROP = 0.04  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_round_table(spec, TABLE_POSITION, TABLE_RADIUS, TABLE_HEIGHT)
    add_cube(spec, "blue", BLUE_POSITION, BLUE_EDGE, BLUE_MASS, rgba=(0.20, 0.45, 0.75, 1.0))
    add_cube(spec, "red", RED_POSITION, RED_EDGE, RED_MASS)


def _stacked(sim: "Worlds") -> np.ndarray:
    apart = sim.pose("red")[:, :3, 3] - sim.pose("blue")[:, :3, 3]
    on_top = (np.abs(apart[:, 2] - STACKED) < LEVEL) & (norm(apart[:, :2]) < OVER)
    let_go = sim.contact_force("right", "red") == 0.0
    return on_top & let_go & (sim.pair_force("red", "blue") > RESTING_N)


def _dropped(sim: "Worlds") -> np.ndarray:
    return np.any([sim.pose(name)[:, 2, 3] < sim.start_pose(name)[:, 2, 3] - DROP for name in ("red", "blue")], axis=0)


TASK = Task(
    name="StackCube",
    description="Walk to the table, take the red cube with the right gripper and set it on the blue cube.",
    hands="gripper",
    build=_build,
    objects=(
        ObjectSpec(name="red", position=RED_POSITION, symmetry=QUARTER_TURNS),
        ObjectSpec(name="blue", position=BLUE_POSITION, symmetry=QUARTER_TURNS),
    ),
    success=_stacked,
    failures={"dropped": _dropped},
    gaze_target="red",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "red"),),
    force_pairs=(("red", "blue"),),
    motion_frame="scene",
    spreads={
        "red": Spread(x=(-0.03, 0.03), y=(-0.025, 0.025), yaw=(-math.pi / 4, math.pi / 4), everywhere=True),
        "blue": Spread(x=(-0.03, 0.03), y=(-0.015, 0.035), yaw=(-math.pi / 4, math.pi / 4), everywhere=True),
    },
    goals={"red": Goal(object="blue", any_yaw=True)},
    episode_length_s=35.0,
)
