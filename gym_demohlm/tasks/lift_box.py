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
from gym_demohlm.task import ObjectSpec, Task, dropped

if TYPE_CHECKING:
    from gym_demohlm.worlds import Worlds

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
    for name, kind, size, touches in (
        ("stand", mujoco.mjtGeom.mjGEOM_CYLINDER, [STAND_RADIUS, STAND_HEIGHT / 2, 0], ROBOT_BIT),
        ("stand_top", mujoco.mjtGeom.mjGEOM_BOX, [square, square, STAND_HEIGHT / 2], WORLD_BIT),
    ):
        geom = stand.add_geom(name=name, type=kind, size=size, pos=[0, 0, STAND_HEIGHT / 2], rgba=[0.45, 0.38, 0.32, 1])
        geom.contype, geom.conaffinity = 0, touches
    box = spec.worldbody.add_body(name="box", pos=BOX_POSITION)
    box.add_freejoint(name="box")
    box.add_geom(
        name="box",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[length / 2 for length in BOX_SIZE],
        mass=BOX_MASS,
        contype=WORLD_BIT,
        conaffinity=ROBOT_BIT | WORLD_BIT,
        condim=4,
        friction=[1.0, 0.01, 0.001],
        rgba=[0.78, 0.57, 0.33, 1],
    )


def _lifted(sim: "Worlds") -> np.ndarray:
    near = sim.distance("pelvis", "box") < HOLDING_DISTANCE
    return near & (sim.pose("box")[:, 2, 3] > LIFTED_HEIGHT)


TASK = Task(
    name="LiftBox",
    description="Walk to the box and lift it with both hands.",
    hands="rubber",
    build=_build,
    objects=(ObjectSpec(name="box", position=BOX_POSITION, symmetry=(0.0, math.pi / 2, math.pi, -math.pi / 2)),),
    success=_lifted,
    failures={"dropped": dropped("box", DROP)},
    gaze_target="box",
    supports=("stand",),
    obstacles=("stand",),
    contact_pairs=(("left", "box"), ("right", "box")),
)
