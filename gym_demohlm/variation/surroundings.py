"""A task and its spec -> furniture that collides as it looks, and cans beside the objects; and where the cans stand.

It changes which bodies there are, so all worlds of a simulation share it. What differs from world to world is in
``bodies``. A round table stands on its visible foot, loose things rest on its round top to the rim, and legs are long
enough for the highest region.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import ROBOT_BIT, WORLD_BIT
from gym_demohlm.task import Task
from gym_demohlm.variation.conditions import Conditions
from gym_demohlm.variation.factors import CLUTTER

_RADIUS, _HALF_HEIGHT, _MASS = 0.020, 0.040, 0.15  # m, m, kg: of the largest can
_SMALLEST = 0.75  # share of that size
_DIRECTIONS = (math.radians(20.0), math.radians(65.0))  # from straight behind the objects
_GAP = 0.012  # m, between a can and an object at the nearest
_RIM = 0.008  # m, between a can and the rim
_LEG = 0.045  # m: geoms of furniture that are narrower than this are legs
_FLOOR = 0.02  # m: geoms of furniture that begin below this stand on the floor
_LONGER = 0.25  # m, further than a region lifts a table
_GREEN = (0.25, 0.55, 0.35, 1.0)


@dataclass(frozen=True, kw_only=True)
class Top:
    """The upper face of a table.

    Attributes:
        centre: (3,) of the face, as the scene is built [m].
        half: (2,) half lengths along x and y; a round top has its radius twice [m].
        is_round: Whether it is round.
    """

    centre: np.ndarray
    half: np.ndarray
    is_round: bool


def furnish(spec: mujoco.MjSpec, task: Task) -> None:
    """Make furniture collide and add the cans, in place; where there is no table for them, there are none."""
    for name in task.supports:
        _make_solid(spec, spec.body(name))
    if table_top(spec, task) is None:
        return
    for name in CLUTTER:
        can = spec.worldbody.add_body(name=name, pos=[2.0, 0.0, _HALF_HEIGHT])
        can.add_freejoint(name=name)
        geom = can.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[_RADIUS, _HALF_HEIGHT, 0], mass=_MASS)
        geom.name, geom.rgba = name, _GREEN
        geom.contype, geom.conaffinity, geom.condim = WORLD_BIT, ROBOT_BIT | WORLD_BIT, 4
        geom.friction, geom.solref, geom.solmix = [1.0, 0.01, 0.001], [0.005, 1.0], 1e3


def resize_clutter(spec: mujoco.MjSpec, conditions: Conditions) -> None:
    """Give the cans their sizes, in place."""
    for name in CLUTTER:
        numbers = conditions.numbers("scene.clutter", name)
        if numbers is not None and spec.body(name) is not None:
            size = _can_size(numbers)
            (geom,) = spec.body(name).geoms
            geom.size, geom.mass = [_RADIUS * size, _HALF_HEIGHT * size, 0], _MASS * size**3


def table_top(spec: mujoco.MjSpec, task: Task) -> Top | None:
    """Return the top of the first support, if it is a table that a loose object stands on and that has room beside."""
    if not task.supports:
        return None
    body = spec.body(task.supports[0])
    plates = [geom for geom in body.geoms if geom.size[0] > _LEG and _half_height(geom) < 0.03]
    if not plates:
        return None
    top = max(plates, key=lambda geom: (geom.pos[2], geom.size[0]))
    is_round = top.type == mujoco.mjtGeom.mjGEOM_CYLINDER
    half = np.full(2, top.size[0]) if is_round else np.array(top.size[:2])
    centre = np.array(body.pos) + np.array(top.pos) + [0.0, 0.0, _half_height(top)]
    return Top(centre=centre, half=half, is_round=is_round)


def place_clutter(
    conditions: Conditions, top: Top, objects: np.ndarray, radii: np.ndarray, facing: float = 0.0
) -> dict[str, tuple[float, float, float]]:
    """Return where the cans stand [m], as if the table were where the scene is built.

    They stand behind the objects as seen from where the robot handles them. Where no place is free, a can stands far
    away on the floor.

    Args:
        conditions: Of the world.
        top: Of the table.
        objects: (n, 2) middles of the objects on it [m].
        radii: (n,) of circles around them [m].
        facing: Where the robot looks as it handles them, from the world's x axis on [rad].
    """
    half = top.half * conditions.number("scene.table_width", plain=1.0)
    places = {}
    for index, name in enumerate(CLUTTER):
        numbers = conditions.numbers("scene.clutter", name)
        size = 1.0 if numbers is None else _can_size(numbers)
        found = None
        if numbers is not None:
            angle = facing + (1 - 2 * index) * float(np.interp(numbers[1], (0.0, 1.0), _DIRECTIONS))
            found = _free_place(numbers[0], angle, top, half, objects, radii, _RADIUS * size)
        if found is None:
            places[name] = (3.0, 0.5 * (2 * index - 1), _HALF_HEIGHT * size + 1e-4)
        else:
            places[name] = (*found, float(top.centre[2]) + _HALF_HEIGHT * size + 1e-4)
    return places


def _free_place(
    nearness: float,
    angle: float,
    top: Top,
    half: np.ndarray,
    objects: np.ndarray,
    radii: np.ndarray,
    radius: float,
) -> tuple[float, float] | None:
    """Return a free place (x, y) on a ray from the objects' middle, from the nearest (0) to the farthest (1)."""
    middle, ray = objects.mean(axis=0), np.array([math.cos(angle), math.sin(angle)])
    free = []
    for distance in np.arange(0.0, 0.6, 0.005):
        place = middle + distance * ray
        apart = np.sqrt(((objects - place) ** 2).sum(axis=1)) - radii - radius
        offset = np.abs(place - top.centre[:2])
        on_top = (
            np.hypot(*offset) <= half[0] - radius - _RIM if top.is_round else (offset <= half - radius - _RIM).all()
        )
        if on_top and (apart >= _GAP).all():
            free.append(place)
    if not free:
        return None
    x, y = free[round(nearness * (len(free) - 1))]
    return float(x), float(y)


def _can_size(numbers: tuple[float, ...]) -> float:
    return _SMALLEST + (1.0 - _SMALLEST) * numbers[2]


def _half_height(geom: mujoco.MjsGeom) -> float:
    return float(geom.size[1] if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER else geom.size[2])


def _make_solid(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Let a piece of furniture collide with robot and things wherever it is seen, and make its legs longer."""
    inner = [geom for geom in body.geoms if geom.contype == 0 and geom.conaffinity == WORLD_BIT]
    outer = [geom for geom in body.geoms if geom.contype == 0 and geom.conaffinity == ROBOT_BIT]
    for geom in inner if outer else []:
        spec.delete(geom)  # things rest on what is seen, not on a square inside of it
    for geom in body.geoms:
        if geom.contype == 0 and geom.conaffinity == 0:
            geom.friction, geom.solref, geom.solmix, geom.condim = [1.0, 0.01, 0.001], [0.005, 1.0], 1e3, 4
        geom.contype, geom.conaffinity = WORLD_BIT, ROBOT_BIT | WORLD_BIT
        stands = geom.type != mujoco.mjtGeom.mjGEOM_ELLIPSOID and geom.pos[2] - _half_height(geom) < _FLOOR
        if stands:
            size, place = np.array(geom.size), np.array(geom.pos)
            size[1 if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER else 2] += _LONGER / 2
            place[2] -= _LONGER / 2
            geom.size, geom.pos = size, place
