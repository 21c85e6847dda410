"""LiftBox: walk to a box on a stand and lift it between the palms.

Source: the paper's "Task Settings" and "Success Conditions". The box stands on a round stand 0.2 m high, so that its
centre is at the paper's 0.29 m. Changed: the region's y and z offsets move the stand with the box (at -0.2 m the box
stands on the floor); otherwise the box would start in the air or tip over the stand's edge.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import ROBOT_BIT, WORLD_BIT
from gym_demohlm.scene.furniture import CARDBOARD, DARK_WOOD, HALF_TURNS, QUARTER_TURNS, add_shape
from gym_demohlm.task import Lengths, ObjectSpec, Task, WideForm, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

BOX_SIZE, OBLONG_SIZE = (0.26, 0.26, 0.18), (0.22, 0.30, 0.18)  # m; the latter in R4
BOX_MASS = 1.0  # kg
STAND_RADIUS, STAND_HEIGHT = 0.10, 0.20  # m
BOX_POSITION = (0.35, 0.0, STAND_HEIGHT + BOX_SIZE[2] / 2)
LIFTED_HEIGHT = 0.6  # m, the box's centre
HOLDING_DISTANCE = 0.6  # m, pelvis to the box's centre
DROP = 0.05  # m below its start


def _build(spec: mujoco.MjSpec, box_size: Lengths = BOX_SIZE) -> None:
    stand = spec.worldbody.add_body(name="stand", mocap=True, pos=[BOX_POSITION[0], BOX_POSITION[1], 0])
    # The robot touches the cylinder; the box rests on a square inside it, because a box is steadier on a box.
    square = STAND_RADIUS / math.sqrt(2)
    for name, shape, half_size, touches in (
        ("stand", "cylinder", [STAND_RADIUS, STAND_HEIGHT / 2], ROBOT_BIT),
        ("stand_top", "box", [square, square, STAND_HEIGHT / 2], WORLD_BIT),
    ):
        geom = add_shape(stand, name, shape, half_size, [0, 0, STAND_HEIGHT / 2], DARK_WOOD)
        geom.contype, geom.conaffinity = 0, touches
    box = spec.worldbody.add_body(name="box", pos=BOX_POSITION)
    box.add_freejoint(name="box")
    add_shape(box, "box", "box", [length / 2 for length in box_size], rgba=CARDBOARD, mass=BOX_MASS)


def _build_oblong(spec: mujoco.MjSpec) -> None:
    _build(spec, OBLONG_SIZE)


def _lifted(sim: "Worlds") -> np.ndarray:
    near = sim.distance("pelvis", "box") < HOLDING_DISTANCE
    return near & (sim.pose("box")[:, 2, 3] > LIFTED_HEIGHT)


TASK = Task(
    name="LiftBox",
    description="Walk to the box and lift it with both hands.",
    hands="rubber",
    build=_build,
    objects=(ObjectSpec(name="box", position=BOX_POSITION, symmetry=QUARTER_TURNS),),
    wide_form=WideForm(
        build=_build_oblong,
        objects=(ObjectSpec(name="box", position=BOX_POSITION, symmetry=HALF_TURNS, resized=(BOX_SIZE, OBLONG_SIZE)),),
    ),
    success=_lifted,
    failures={"dropped": dropped("box", DROP)},
    gaze_target="box",
    supports=("stand",),
    obstacles=("stand",),
    contact_pairs=(("left", "box"), ("right", "box")),
)
