"""CarryBox: take a box from one table between the palms, carry it to another table and set it down there.

Not in the paper. The tables are placed independently, 1 to 2 m apart, and the robot turns on its way. The box is about
one table first and about the other then, with a walk in between while it is held.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.scene import aim_overview
from gym_demohlm.scene.furniture import CARDBOARD, HALF_TURNS, QUARTER_TURNS, add_round_table, add_shape
from gym_demohlm.task import Goal, Lengths, ObjectSpec, Spread, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

BOX_SIZE, BOX_MASS = (0.24, 0.24, 0.16), 0.8  # m, kg
OBLONG_SIZE = (0.20, 0.28, 0.16)  # m, in R4
TABLE_HEIGHT = 0.72  # m, of both tables
TABLE_POSITION, TABLE_RADIUS = (0.42, 0.0), 0.11  # m; narrower than the box, so that palms pass its rim
GOAL_POSITION, GOAL_RADIUS = (0.10, -1.45), 0.17  # m
BOX_POSITION = (*TABLE_POSITION, TABLE_HEIGHT + BOX_SIZE[2] / 2 + 1e-4)
OVER = 0.10  # m, the box's middle from the goal's, seen from above
LEVEL = 0.02  # m, how well its height on the table must fit
DROP = 0.25  # m below its start: lower than any table is


def _build(spec: mujoco.MjSpec, box_size: Lengths = BOX_SIZE) -> None:
    aim_overview(spec, (2.3, -2.9, 1.7), (0.0, -0.6, 0.55))
    add_round_table(spec, TABLE_POSITION, TABLE_RADIUS, TABLE_HEIGHT)
    add_round_table(spec, GOAL_POSITION, GOAL_RADIUS, TABLE_HEIGHT, name="goal")
    box = spec.worldbody.add_body(name="box", pos=BOX_POSITION)
    box.add_freejoint(name="box")
    add_shape(box, "box", "box", [length / 2 for length in box_size], rgba=CARDBOARD, mass=BOX_MASS)


def _build_oblong(spec: mujoco.MjSpec) -> None:
    _build(spec, OBLONG_SIZE)


def _set_down(sim: "Worlds") -> np.ndarray:
    apart = sim.pose("box")[:, :3, 3] - sim.pose("goal")[:, :3, 3]
    on_goal = (norm(apart[:, :2]) < OVER) & (np.abs(apart[:, 2] - TABLE_HEIGHT - BOX_SIZE[2] / 2) < LEVEL)
    let_go = (sim.contact_force("left", "box") == 0.0) & (sim.contact_force("right", "box") == 0.0)
    return on_goal & let_go


TASK = Task(
    name="CarryBox",
    description="Take the box from the first table with both hands, carry it to the other table and set it down.",
    hands="rubber",
    build=_build,
    objects=(
        ObjectSpec(name="box", position=BOX_POSITION, symmetry=QUARTER_TURNS),
        ObjectSpec(name="goal", position=(*GOAL_POSITION, 0.0), symmetry="any"),
    ),
    wide_form=WideForm(
        build=_build_oblong,
        objects=(
            ObjectSpec(name="box", position=BOX_POSITION, symmetry=HALF_TURNS, resized=(BOX_SIZE, OBLONG_SIZE)),
            ObjectSpec(name="goal", position=(*GOAL_POSITION, 0.0), symmetry="any"),
        ),
    ),
    success=_set_down,
    failures={"dropped": dropped("box", DROP)},
    gaze_target="box",
    searched=("goal",),
    supports=("table", "goal"),
    obstacles=("table", "goal"),
    contact_pairs=(("left", "box"), ("right", "box")),
    spreads={"goal": Spread(x=(-0.25, 0.25), y=(-0.25, 0.25), everywhere=True)},
    goals={"box": Goal(object="goal", any_yaw=True)},
    episode_length_s=60.0,
)
