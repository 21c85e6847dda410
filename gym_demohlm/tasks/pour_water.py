"""PourWater: take a bottle from a table with the right gripper and pour its water into a bowl on its left.

Source: the paper's "Task Settings" and "Success Conditions". Changed: the paper compares the bottle with itself; here
the bottle must be near the bowl, seen from above, and most of the water (small spheres) must be in the bowl. Bottle and
bowl are round, so the region's yaw makes no difference; the table and both vessels move with its y and z offsets. In
R4 each of the two is also placed by itself.
"""

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.robot.g1 import WORLD_BIT
from gym_demohlm.scene.furniture import LIQUID_BIT, UNYIELDING, add_picture, add_shape, add_table, add_vessel
from gym_demohlm.task import Goal, ObjectSpec, Spread, Task

if TYPE_CHECKING:
    from gym_demohlm.simulation.worlds import Worlds

TABLE_POSITION, TABLE_HALF, TABLE_HEIGHT = (0.42, 0.0), (0.17, 0.34), 0.75  # m
BOTTLE_RADIUS, BOTTLE_HEIGHT, BOTTLE_WALL = 0.031, 0.16, 0.008  # m
BOWL_RADIUS, BOWL_HEIGHT, BOWL_WALL = 0.068, 0.07, 0.010  # m
BOTTLE_MASS, BOWL_MASS = 0.30, 0.40  # kg
BOTTLE_POSITION = (0.37, -0.11, TABLE_HEIGHT + BOTTLE_HEIGHT / 2)
BOWL_POSITION = (0.37, 0.12, TABLE_HEIGHT + BOWL_HEIGHT / 2)
NUM_DROPS, DROP_RADIUS, DROP_MASS = 15, 0.009, 0.003  # m, kg: water
SHORT = (0.004, 1.0)  # MuJoCo's solref of table, bottle and bowl: as short as its time step allows
DROPS = tuple(f"drop_{index}" for index in range(NUM_DROPS))
NEAR = 0.10  # m, bottle to bowl seen from above
POURED = 0.75  # of the drops
FALL = 0.05  # m below its start


def _build(spec: mujoco.MjSpec) -> None:
    add_table(spec, TABLE_POSITION, TABLE_HALF, TABLE_HEIGHT)
    glass, clay = (0.55, 0.80, 0.90, 0.30), (0.85, 0.80, 0.70, 1.0)
    add_vessel(spec, "bottle", BOTTLE_POSITION, BOTTLE_RADIUS, BOTTLE_HEIGHT, BOTTLE_WALL, BOTTLE_MASS, glass)
    add_vessel(spec, "bowl", BOWL_POSITION, BOWL_RADIUS, BOWL_HEIGHT, BOWL_WALL, BOWL_MASS, clay)
    for name in ("table_top", "bottle", "bowl"):
        spec.geom(name).solref, spec.geom(name).solimp[:3] = SHORT, UNYIELDING
    spec.geom("table_top").priority = 1  # grippers have it too: against them, its own hardness counts
    bottom = BOTTLE_POSITION[2] - BOTTLE_HEIGHT / 2 + BOTTLE_WALL + DROP_RADIUS
    ring = 1.02 * DROP_RADIUS / math.sin(math.pi / 3)  # three drops a layer
    for index, name in enumerate(DROPS):
        layer, angle = index // 3, 2 * math.pi / 3 * (index % 3) + math.pi / 3 * (index // 3 % 2)
        place = [ring * math.cos(angle), ring * math.sin(angle), 1.75 * DROP_RADIUS * layer + 1e-4]
        drop = spec.worldbody.add_body(name=name, pos=np.add([*BOTTLE_POSITION[:2], bottom], place))
        drop.add_freejoint(name=name)
        geom = add_shape(drop, name, "sphere", [DROP_RADIUS], rgba=(0, 0, 0, 0), mass=DROP_MASS)
        add_picture(drop, "sphere", [1.2 * DROP_RADIUS], rgba=(0.10, 0.45, 0.95, 1.0))  # they flow together
        geom.contype, geom.conaffinity, geom.solimp[:3] = LIQUID_BIT | WORLD_BIT, LIQUID_BIT, UNYIELDING
        geom.condim, geom.priority = 1, 2  # water does not stick: no friction, at a third of the cost of a little


def share_in_bowl(sim: "Worlds") -> np.ndarray:
    """Return the share (N,) of the water that is inside the bowl, whose size may differ from world to world."""
    T_bowl_world, worlds = poses.invert(sim.pose("bowl")), range(sim.num_worlds)
    size = np.array([sim.conditions(world).number("objects.size", "bowl", plain=1.0) for world in worlds])
    inside = []
    for name in DROPS:
        place = poses.transform(T_bowl_world, sim.pose(name)[:, :3, 3])
        inside.append((norm(place[:, :2]) < size * BOWL_RADIUS) & (np.abs(place[:, 2]) < size * BOWL_HEIGHT / 2))
    return np.mean(inside, axis=0)


def _poured(sim: "Worlds") -> np.ndarray:
    apart = sim.pose("bottle")[:, :2, 3] - sim.pose("bowl")[:, :2, 3]
    return sim.holds("right", "bottle") & (norm(apart) < NEAR) & (share_in_bowl(sim) >= POURED)


def _fell(sim: "Worlds") -> np.ndarray:
    return np.any(
        [sim.pose(name)[:, 2, 3] < sim.start_pose(name)[:, 2, 3] - FALL for name in ("bottle", "bowl")], axis=0
    )


TASK = Task(
    name="PourWater",
    description="Pick up the bottle with the right gripper and pour the water into the bowl.",
    hands="gripper",
    build=_build,
    objects=tuple(
        ObjectSpec(name=name, position=position, symmetry="any")
        for name, position in (("bottle", BOTTLE_POSITION), ("bowl", BOWL_POSITION))
    ),
    success=_poured,
    failures={"dropped": _fell},
    gaze_target="bottle",
    supports=("table",),
    obstacles=("table",),
    contact_pairs=(("right", "bottle"),),
    motion_frame="scene",
    riders={"bottle": DROPS},
    spreads={
        "bottle": Spread(x=(-0.04, 0.06), y=(-0.08, 0.03)),
        "bowl": Spread(x=(-0.03, 0.06), y=(-0.03, 0.08)),
    },
    goals={"bottle": Goal(object="bowl", any_yaw=True)},
    episode_length_s=45.0,
)
