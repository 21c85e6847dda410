"""Sizes -> tables and loose things made of primitives, with the collision bits and contact settings of all tasks.

Lengths are in metres, masses in kilograms. A table is a mocap body whose origin is on the floor under its middle: a
task lists it among its supports.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from gym_demohlm.robot.g1 import ROBOT_BIT, WORLD_BIT

Rgba = Sequence[float]
WOOD, DARK_WOOD, STEEL, CARDBOARD, CHALK = (
    (0.72, 0.53, 0.36, 1.0),
    (0.45, 0.38, 0.32, 1.0),
    (0.55, 0.57, 0.60, 1.0),
    (0.78, 0.57, 0.33, 1.0),
    (0.95, 0.95, 0.92, 1.0),
)
TOP_THICKNESS = 0.03
SOFTNESS = (0.005, 1.0)
"""Time constant [s] and damping ratio of contacts: wood and steel that meet at 2 m/s sink in by less than 5 mm."""
UNYIELDING = (0.95, 0.999, 0.001)
"""MuJoCo's solimp of small things on a table, so that a falling robot presses them less far into it."""
_LEG_RADIUS = 0.025
_FOOT_HEIGHT = 0.3
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}


def add_shape(
    body: mujoco.MjsBody,
    name: str,
    shape: str,
    half_size: Sequence[float],
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rgba: Rgba = WOOD,
    mass: float = 0.0,
) -> mujoco.MjsGeom:
    """Add a primitive that collides with the robot and other things, with torsional friction.

    Args:
        body: Body that gets the geom.
        name: Name of the geom.
        shape: "box", "cylinder", "sphere", "capsule" or "ellipsoid".
        half_size: Half lengths of a box or radii of an ellipsoid; radius and half height; or radius [m].
        position: Centre of the geom in the body's frame [m].
        rgba: Colour, 0 to 1.
        mass: Mass of the geom [kg].
    """
    return _make_touching(add_picture(body, shape, half_size, position, rgba, mass), name)


def _make_touching(geom: mujoco.MjsGeom, name: str) -> mujoco.MjsGeom:
    geom.name = name
    geom.contype, geom.conaffinity, geom.condim = WORLD_BIT, ROBOT_BIT | WORLD_BIT, 4
    geom.friction = [1.0, 0.01, 0.001]
    geom.solref, geom.solmix = SOFTNESS, 1e3  # this softness counts, not that of the robot or floor
    return geom


def add_picture(
    body: mujoco.MjsBody,
    shape: str,
    half_size: Sequence[float],
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rgba: Rgba = WOOD,
    mass: float = 0.0,
) -> mujoco.MjsGeom:
    """Add a primitive that is visible and has the given mass, but never collides; arguments as in ``add_shape``."""
    size = [*half_size, *[0.0] * (3 - len(half_size))]
    geom = body.add_geom(type=_SHAPES[shape], size=size, pos=list(position), rgba=list(rgba), mass=mass)
    geom.contype, geom.conaffinity = 0, 0
    return geom


def add_flat_picture(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, outline: np.ndarray, half_height: float, rgba: Rgba = WOOD
) -> mujoco.MjsGeom:
    """Add a flat thing of any convex outline that is visible, but has no mass and never collides.

    Args:
        spec: The scene; its mesh is called like the body.
        body: Body that gets the geom.
        outline: (n, 2) corners around the body's origin, x and y [m].
        half_height: Half of its thickness along the body's z [m].
        rgba: Colour, 0 to 1.
    """
    corners = [[x, y, z] for z in (-half_height, half_height) for x, y in outline]
    spec.add_mesh(name=body.name, uservert=np.ravel(corners))
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=body.name, rgba=list(rgba), mass=0.0)
    geom.contype, geom.conaffinity = 0, 0
    return geom


def add_round_table(
    spec: mujoco.MjSpec,
    position: tuple[float, float],
    radius: float,
    height: float,
    name: str = "table",
    up_to_rim: bool = False,
) -> mujoco.MjsBody:
    """Add a round table on one leg.

    The robot touches the round top. Loose things rest on an invisible square inside it, because a box is steadier on a
    box than on a cylinder.

    Args:
        spec: The scene.
        position: x and y of the table's middle [m].
        radius: Radius of the top [m].
        height: Height of the top's upper face [m].
        name: Name of the mocap body.
        up_to_rim: Whether loose things rest on the round top instead, for a task that moves them over the rim.
    """
    table = spec.worldbody.add_body(name=name, mocap=True, pos=[*position, 0.0])
    middle = height - TOP_THICKNESS / 2
    top = add_shape(table, f"{name}_top", "cylinder", [radius, TOP_THICKNESS / 2], [0, 0, middle], WOOD)
    if not up_to_rim:
        top.contype, top.conaffinity = 0, ROBOT_BIT
        square = [radius / math.sqrt(2), radius / math.sqrt(2), TOP_THICKNESS / 2]
        inner = add_shape(table, f"{name}_square", "box", square, [0, 0, middle], WOOD)
        inner.contype, inner.conaffinity, inner.rgba = 0, WORLD_BIT, [0, 0, 0, 0]
    add_shape(table, f"{name}_leg", "cylinder", [_LEG_RADIUS, height / 2], [0, 0, height / 2 - TOP_THICKNESS], STEEL)
    # Leg and foot go through the floor when the table is lowered; a dome still looks like a foot then.
    widest = min(0.8 * radius, 0.14)
    add_picture(table, "ellipsoid", [widest, widest, _FOOT_HEIGHT], rgba=STEEL)
    return table


def add_table(
    spec: mujoco.MjSpec,
    position: tuple[float, float],
    half_length: tuple[float, float],
    height: float,
    name: str = "table",
) -> mujoco.MjsBody:
    """Add a rectangular table on four legs.

    Args:
        spec: The scene.
        position: x and y of the table's middle [m].
        half_length: Half lengths of the top along x and y [m].
        height: Height of the top's upper face [m].
        name: Name of the mocap body.
    """
    table = spec.worldbody.add_body(name=name, mocap=True, pos=[*position, 0.0])
    x, y = half_length
    add_shape(table, f"{name}_top", "box", [x, y, TOP_THICKNESS / 2], [0, 0, height - TOP_THICKNESS / 2], WOOD)
    for index in range(4):
        sign_x, sign_y = 1 - 2 * (index % 2), 1 - 2 * (index // 2)
        corner = [sign_x * (x - 0.03), sign_y * (y - 0.03), height / 2 - TOP_THICKNESS / 2]
        add_shape(table, f"{name}_leg_{index}", "box", [0.02, 0.02, height / 2 - TOP_THICKNESS / 2], corner, DARK_WOOD)
    return table


def add_cube(
    spec: mujoco.MjSpec,
    name: str,
    position: tuple[float, float, float],
    edge: float,
    mass: float,
    rgba: Rgba = (0.80, 0.25, 0.20, 1.0),
) -> mujoco.MjsBody:
    """Add a loose cube.

    Args:
        spec: The scene.
        name: Name of the body, its free joint and its geom.
        position: Centre of the cube [m].
        edge: Length of an edge [m].
        mass: Mass of the cube [kg].
        rgba: Colour, 0 to 1.
    """
    body = spec.worldbody.add_body(name=name, pos=list(position))
    body.add_freejoint(name=name)
    add_shape(body, name, "box", [edge / 2] * 3, rgba=rgba, mass=mass)
    return body


def add_mark(spec: mujoco.MjSpec, name: str, edge: float) -> None:
    """Paint a stripe on a cube, over its top and down the side towards negative x, so that it has a front.

    Args:
        spec: The scene.
        name: Name of the cube's body.
        edge: Length of an edge of the cube [m].
    """
    body, half, thin = spec.body(name), edge / 2, 2e-4
    add_picture(body, "box", [thin, edge / 6, half], [-half, 0.0, 0.0], CHALK)
    add_picture(body, "box", [edge / 4, edge / 6, thin], [-edge / 4, 0.0, half], CHALK)


QUARTER_TURNS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Turns about the vertical after which a cube looks the same."""
HALF_TURNS = (0.0, math.pi)
"""Turns about the vertical after which a box with two lengths looks the same."""


LIQUID_BIT = 8
"""Collision bit of drops: they collide with each other, the inner walls of vessels, and everything in the world."""


def add_vessel(
    spec: mujoco.MjSpec,
    name: str,
    position: tuple[float, float, float],
    radius: float,
    height: float,
    wall: float,
    mass: float,
    rgba: Rgba,
) -> mujoco.MjsBody:
    """Add a loose, open, round vessel.

    Hands and table touch a full cylinder; drops touch eight walls and a bottom inside it. These geoms are invisible.
    Visible ones are drawn over them: finer walls, or glass as one piece with its rim.

    Args:
        spec: The scene.
        name: Name of the body, its free joint and its outer geom.
        position: Middle of the vessel [m].
        radius: Outer radius [m].
        height: Outer height [m].
        wall: Thickness of walls and bottom [m]; drops pass through walls thinner than their way in a few steps.
        mass: Mass of the empty vessel [kg].
        rgba: Colour, 0 to 1; a transparent vessel gets a visible rim.
    """
    body = spec.worldbody.add_body(name=name, pos=list(position))
    body.add_freejoint(name=name)
    outside = add_shape(body, name, "cylinder", [radius, height / 2], mass=mass, rgba=(0, 0, 0, 0))
    outside.contype, outside.conaffinity = WORLD_BIT, ROBOT_BIT
    bottom = add_picture(body, "cylinder", [radius, wall / 2], [0, 0, (wall - height) / 2], (0, 0, 0, 0))
    for index, part in enumerate([bottom, *_add_ring(body, radius, wall, 8, (-height / 2, height / 2), (0, 0, 0, 0))]):
        _make_touching(part, f"{name}_inside_{index}")
        part.contype, part.conaffinity = 0, LIQUID_BIT
    if rgba[3] < 1.0:
        add_picture(body, "cylinder", [radius, height / 2], rgba=rgba)
        _add_ring(body, 1.01 * radius, wall, 24, (height / 2 - 0.006, height / 2), (*rgba[:3], 0.5 + rgba[3] / 2))
    else:
        add_picture(body, "cylinder", [0.99 * radius, wall / 2], [0, 0, (wall - height) / 2], rgba)
        _add_ring(body, radius, wall, 24, (-height / 2, height / 2), rgba)
    return body


def _add_ring(
    body: mujoco.MjsBody, radius: float, wall: float, count: int, heights: tuple[float, float], rgba: Rgba
) -> list[mujoco.MjsGeom]:
    """Add a round wall of visible boxes around the vertical axis; their outer corners meet."""
    sides = []
    for index in range(count):
        angle, reach = 2 * math.pi / count * index, radius - wall / 2
        middle = [reach * math.cos(angle), reach * math.sin(angle), (heights[0] + heights[1]) / 2]
        half_size = [wall / 2, radius * math.tan(math.pi / count), (heights[1] - heights[0]) / 2]
        side = add_picture(body, "box", half_size, middle, rgba)
        side.quat = [math.cos(angle / 2), 0, 0, math.sin(angle / 2)]
        sides.append(side)
    return sides
