"""The table under an object, as demonstrated and as it stands here -> a place before it, and a hand's way over it.

In R4 a table may be higher than the demonstrated one, and the robot may come to it at an angle. A robot that stood as
near to the object as the demonstrated one would run into the table's edge, and hands that hang lower than the table
would come up under it. So the robot keeps the demonstrated distance from the edge, and its hands rise before they reach
out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from gym_demohlm.variation import Conditions
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation.clearance import TOLERANCE_M
from lerobot_demohlm.generation.world_view import WorldView

_STEP_M = 0.01  # by which a place is moved back


@dataclass(frozen=True, kw_only=True)
class TableSettings:
    """How a robot keeps clear of a table that is not where the demonstrated one was.

    Attributes:
        clear_m: Height above the table to which palms rise before they reach over it [m].
        back_m: Distance by which they are drawn back as they rise [m].
        half_width_m: Half the width of the robot that keeps its distance from the edge [m].
        most_back_m: Largest distance by which the robot stands further back for it [m].
    """

    clear_m: float = 0.08
    back_m: float = 0.05
    half_width_m: float = 0.18
    most_back_m: float = 0.25


@dataclass(frozen=True, kw_only=True)
class Table:
    """The top of a table as it stands.

    Attributes:
        T_world_table: (4, 4) pose of the table.
        half: (2,) half lengths of the top along the table's x and y [m]; a round top has its radius twice.
        is_round: Whether the top is round.
        height: Of its upper face [m].
    """

    T_world_table: np.ndarray
    half: np.ndarray
    is_round: bool
    height: float

    def gap(self, base: np.ndarray, half_width_m: float) -> float:
        """Return how far a robot at a base pose (3,) x, y, yaw is from the edge, as seen from above [m]."""
        across = np.array([[0.0, side, 0.0] for side in (-half_width_m, 0.0, half_width_m)])
        p_world = poses.transform(poses.planar(*base), across)
        xy = np.abs(poses.transform(poses.invert(self.T_world_table), p_world)[:, :2])
        apart = norm(xy) - self.half[0] if self.is_round else norm(np.maximum(xy - self.half, 0.0))
        return float(apart.min())

    def way_to_edge(self, p_world: np.ndarray, ahead: np.ndarray) -> float:
        """Return how far it is from a point (3,) over the top to its edge, in a level unit direction (3,) [m]."""
        T_table_world = poses.invert(self.T_world_table)
        p, u = poses.transform(T_table_world, p_world)[:2], (T_table_world[:3, :3] @ ahead)[:2]
        if self.is_round:
            along = float(dot(p, u))
            return math.sqrt(max(along**2 - float(dot(p, p)) + float(self.half[0]) ** 2, 0.0)) - along
        ways = [(math.copysign(half, v) - x) / v for half, x, v in zip(self.half, p, u, strict=True) if abs(v) > 1e-9]
        return float(min(ways))


def tables_under(
    world: WorldView, task: Task, demonstration: Demonstration, first: Segment
) -> tuple[Table, Table] | None:
    """Return the demonstrated table under the object of the first approach and the same one here; None without one."""
    if not task.supports or first.object is None:
        return None
    model, mocap = world.sim.model, demonstration.start["mocap"][0]
    numbers = {name: int(model.body(name).mocapid[0]) for name in task.supports}
    positions = {name: mocap[3 * number :][:3] for name, number in numbers.items()}
    index = [entry.name for entry in task.objects].index(first.object)
    p_object = demonstration.T_world_objects[first.start, index, :2, 3]
    name = min(positions, key=lambda name: float(norm(positions[name][:2] - p_object)))
    quat = mocap[3 * model.nmocap + 4 * numbers[name] :][:4]
    top, plain = _top(model, name), world.sim.scene.shapes(Conditions())
    middle, half = np.split(plain.geom_aabb[top], 2)
    above = plain.geom_pos[top, 2] + middle[2] + half[2]
    is_round = bool(model.geom_type[top] == mujoco.mjtGeom.mjGEOM_CYLINDER)

    def table(T_world_table: np.ndarray, width: float) -> Table:
        height = float(T_world_table[2, 3] + above)
        return Table(T_world_table=T_world_table, half=width * half[:2], is_round=is_round, height=height)

    width = world.sim.conditions(world.index).number("scene.table_width", plain=1.0)
    return table(poses.pose(positions[name], quat), 1.0), table(world.pose(name), width)


def stand_off(
    goal: np.ndarray, demonstrated: np.ndarray, tables: tuple[Table, Table], settings: TableSettings
) -> np.ndarray:
    """Return a base goal (3,), moved straight back until it is as far from the edge as the demonstrated base was.

    Args:
        goal: (3,) x, y, yaw [m, m, rad].
        demonstrated: (3,) where the robot stood in the demonstration.
        tables: The demonstrated table, and the one here.
        settings: How far at most.
    """
    then, now = tables
    least = then.gap(demonstrated, settings.half_width_m) - TOLERANCE_M
    ahead = poses.planar(*goal)[:2, 0]
    moved = goal
    for back in np.arange(0.0, settings.most_back_m + _STEP_M / 2, _STEP_M):
        moved = np.append(goal[:2] - back * ahead, goal[2])
        if now.gap(moved, settings.half_width_m) >= least:
            break
    return moved


def reaching(segments: Sequence[Segment]) -> list[int]:
    """Return the hands, by number, that go to an object at once."""
    return [g1.SIDES.index(entry.hand) for entry in segments if entry.kind == "object" and entry.start == 0]


def risen(palms: np.ndarray, hands: Sequence[int], height_m: float, back: np.ndarray) -> np.ndarray:
    """Return where palms (2, 4, 4) are once some that are lower than a height have risen to it.

    Args:
        palms: (2, 4, 4) before that.
        hands: Which rise.
        height_m: In the world [m].
        back: (2,) by which they are drawn back on the way [m].
    """
    result = palms.copy()
    for hand in hands:
        if palms[hand, 2, 3] < height_m:
            result[hand, :3, 3] = *(palms[hand, :2, 3] + back), height_m
    return result


def kept_above(path: np.ndarray, height_m: float) -> np.ndarray:
    """Return a palm's way (T, 4, 4) on which it is at a height [m] at once, and no lower until the way itself is.

    If the way never is as high, its own largest height counts.
    """
    heights = path[:, 2, 3]
    enough = min(height_m, float(heights.max()))
    first = int(np.argmax(heights >= enough))
    result = path.copy()
    result[:first, 2, 3] = enough
    return result


def _top(model: mujoco.MjModel, name: str) -> int:
    """Return the geom with the highest upper face of those of a body that collide; of equal ones the widest."""
    own = np.flatnonzero((model.geom_bodyid == model.body(name).id) & (model.geom_contype | model.geom_conaffinity))
    faces = np.round(model.geom_pos[own, 2] + model.geom_aabb[own, 2] + model.geom_aabb[own, 5], 6)
    return int(max(zip(faces, model.geom_aabb[own, 3], own, strict=True))[2])
