"""LiftBox: walk to a box on a stand and lift it between the palms.

Source: the paper's "Task Settings" and "Success Conditions". The box stands on a round stand 0.2 m high, so that its
centre is at the paper's 0.29 m. Mended: the region's y and z offsets move the stand with the box (at -0.2 m the box
stands on the floor), or it would start in the air, or tip over the stand's edge.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import ROBOT_BIT, WORLD_BIT
from gym_demohlm.scene.furniture import CARDBOARD, DARK_WOOD, QUARTER_TURNS, add_shape
from gym_demohlm.task import ObjectSpec, Task, dropped

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

BOX_SIZE = (0.26, 0.26, 0.18)  # m
BOX_MASS = 1.0  # kg
STAND_RADIUS, STAND_HEIGHT = 0.10, 0.20  # m
BOX_POSITION = (0.35, 0.0, STAND_HEIGHT + BOX_SIZE[2] / 2)
LIFTED_HEIGHT = 0.6  # m, the box's centre
HOLDING_DISTANCE = 0.6  # m, pelvis to the box's centre
DROP = 0.05  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    stand = spec.worldbody.add_body(name="stand", mocap=True, pos=[BOX_POSITION[0], BOX_POSITION[1], 0])
    # The robot meets the cylinder; the box rests on a square inside it, whose contacts with a box are steadier.
    square = STAND_RADIUS / math.sqrt(2)
    for name, shape, half_size, touches in (
        ("stand", "cylinder", [STAND_RADIUS, STAND_HEIGHT / 2], ROBOT_BIT),
        ("stand_top", "box", [square, square, STAND_HEIGHT / 2], WORLD_BIT),
    ):
        geom = add_shape(stand, name, shape, half_size, [0, 0, STAND_HEIGHT / 2], DARK_WOOD)
        geom.contype, geom.conaffinity = 0, touches
    box = spec.worldbody.add_body(name="box", pos=BOX_POSITION)
    box.add_freejoint(name="box")
    add_shape(box, "box", "box", [length / 2 for length in BOX_SIZE], rgba=CARDBOARD, mass=BOX_MASS)


def _lifted(sim: "Worlds") -> np.ndarray:
    near = sim.distance("pelvis", "box") < HOLDING_DISTANCE
    return near & (sim.pose("box")[:, 2, 3] > LIFTED_HEIGHT)


TASK = Task(
    name="LiftBox",
    description="Walk to the box and lift it with both hands.",
    hands="rubber",
    build=_build,
    objects=(ObjectSpec(name="box", position=BOX_POSITION, symmetry=QUARTER_TURNS),),
    success=_lifted,
    failures={"dropped": dropped("box", DROP)},
    gaze_target="box",
    supports=("stand",),
    obstacles=("stand",),
    contact_pairs=(("left", "box"), ("right", "box")),
)
