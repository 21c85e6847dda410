"""Conditions and the spec of a scene -> the spec of one world: objects, hinges, furniture and robot as it has them."""

import mujoco
import numpy as np

from gym_demohlm.robot import g1
from gym_demohlm.variation.conditions import Conditions
from gym_demohlm.variation.factors import LIMBS

TORSO = "torso_link"
WIDE = 0.06  # m: of a table's geoms, those with a larger half width are its top or foot, and the others its legs
_LOCKED_N = 50.0  # dry friction from which on a joint is a clamp and no hinge


def vary(
    spec: mujoco.MjSpec,
    plain: mujoco.MjModel,
    conditions: Conditions,
    *,
    loose: tuple[str, ...],
    resizable: tuple[str, ...],
    supports: tuple[str, ...],
) -> None:
    """Change a spec in place.

    Args:
        spec: A copy of the scene's spec.
        plain: What the scene's spec compiles to.
        conditions: Of the world.
        loose: Names of the tracked objects that have a free joint.
        resizable: Those of them whose size may change.
        supports: Names of the bodies of the furniture under objects.
    """
    for name in loose:
        size = conditions.number("objects.size", name, plain=1.0) if name in resizable else 1.0
        mass = conditions.number("objects.mass", name, plain=1.0)
        shift = conditions.numbers("objects.com", name)
        _vary_object(spec, plain, name, size, mass, np.zeros(3) if shift is None else np.array(shift))
    _vary_friction(spec, conditions.number("objects.friction", plain=1.0))
    _vary_hinges(spec, conditions.number("objects.hinge", plain=1.0))
    _vary_robot(spec, plain, conditions)
    _widen(spec, supports, conditions.number("scene.table_width", plain=1.0))
    _set_floor(spec, conditions.numbers("scene.floor"))


def lowest_point(model: mujoco.MjModel, body: str) -> float:
    """Return the height of a body's lowest point that collides, in the body's own frame [m]."""
    heights = []
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] == model.body(body).id and (
            model.geom_contype[geom] or model.geom_conaffinity[geom]
        ):
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, model.geom_quat[geom])
            R = R.reshape(3, 3)
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            heights.append(model.geom_pos[geom, 2] + (R[2] * centre).sum() - (np.abs(R[2]) * half).sum())
    return min(heights, default=0.0)


def _vary_object(
    spec: mujoco.MjSpec, plain: mujoco.MjModel, name: str, size: float, mass: float, shift: np.ndarray
) -> None:
    """Give a loose object its size and mass, and a centre of mass that is off by shares of its half size."""
    body = spec.body(name)
    for geom in body.geoms:
        geom.size, geom.pos = np.array(geom.size) * size, np.array(geom.pos) * size
    half = _half_size(plain, name)
    _set_inertia(spec, plain, name, mass, size, shift * half * size)
    for child in _below(body):
        _set_inertia(spec, plain, child.name, mass)


def _half_size(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return half the extent (3,) of a body's own geoms that collide, along its axes [m].

    Geoms count as if they were not turned within the body, and a body whose geoms belong to its parts has none. To mend
    either would change the worlds that results are of (docs/variation.md, "What is not varied").
    """
    own = model.geom_bodyid == model.body(name).id
    own &= (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    if not own.any():
        return np.zeros(3)
    middle, reach = model.geom_pos[own] + model.geom_aabb[own, :3], model.geom_aabb[own, 3:]
    return ((middle + reach).max(axis=0) - (middle - reach).min(axis=0)) / 2


def _set_inertia(
    spec: mujoco.MjSpec,
    plain: mujoco.MjModel,
    name: str,
    mass: float,
    size: float = 1.0,
    shift: np.ndarray | None = None,
    added: float = 0.0,
) -> None:
    """Write a body's inertia: the plain one by a mass ratio and a size, its centre shifted [m], with a weight [kg]."""
    body, compiled = spec.body(name), plain.body(name)
    before = float(compiled.mass[0])
    if before <= 0.0:
        return
    ratio = max(mass + added / before, 0.05)
    body.explicitinertial = True
    body.mass = before * ratio
    body.ipos = compiled.ipos * size + (np.zeros(3) if shift is None else shift)
    body.iquat = compiled.iquat
    body.inertia = compiled.inertia * ratio * size * size
    body.fullinertia = np.full(6, np.nan)


def _vary_friction(spec: mujoco.MjSpec, ratio: float) -> None:
    """Multiply the sliding friction of all but floor and feet."""
    if ratio == 1.0:
        return
    for geom in spec.geoms:
        if geom.name != "floor" and "foot" not in geom.name and (geom.contype or geom.conaffinity):
            geom.friction = [geom.friction[0] * ratio, *geom.friction[1:]]


def _vary_hinges(spec: mujoco.MjSpec, ratio: float) -> None:
    """Multiply damping and dry friction of the joints that are not the robot's."""
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    robot = {body.name for body in _below(spec.body("pelvis"))}
    for joint in spec.joints:
        if joint.type in single and joint.parent.name not in robot and joint.frictionloss < _LOCKED_N:
            joint.damping = np.array(joint.damping) * ratio
            joint.frictionloss *= ratio


def _vary_robot(spec: mujoco.MjSpec, plain: mujoco.MjModel, conditions: Conditions) -> None:
    for limb, joints in LIMBS.items():
        strength = conditions.number("robot.strength", limb, plain=1.0)
        mass = conditions.number("robot.link_mass", limb, plain=1.0)
        for joint in joints:
            servo = spec.actuator(joint)
            servo.forcerange = np.array(servo.forcerange) * strength
            link = spec.joint(f"{joint}_joint").parent.name
            if mass != 1.0 and link != TORSO:
                _set_inertia(spec, plain, link, mass)
    share = conditions.number("robot.dry_friction", plain=0.0)
    for joint in (*g1.LEG_JOINTS, *g1.WAIST_JOINTS) if share > 0.0 else ():
        element = spec.joint(f"{joint}_joint")
        element.frictionloss = share * g1.motor(joint).dry_friction
    payload, shift = conditions.number("robot.payload", plain=0.0), conditions.numbers("robot.torso_com")
    mass = conditions.number("robot.link_mass", "waist", plain=1.0)
    if payload != 0.0 or shift is not None or mass != 1.0:
        moved = np.zeros(3) if shift is None else np.array(shift)
        _set_inertia(spec, plain, TORSO, mass, shift=moved, added=payload)


def _widen(spec: mujoco.MjSpec, supports: tuple[str, ...], ratio: float) -> None:
    """Make tables wider: tops and feet grow, legs go apart, and what is fixed on them stays where it is."""
    if ratio == 1.0:
        return
    for name in supports:
        for geom in spec.body(name).geoms:
            size, place = np.array(geom.size), np.array(geom.pos)
            place[:2] *= ratio
            if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER and size[0] > WIDE:
                size[0] *= ratio
            elif geom.type in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID) and size[0] > WIDE:
                size[:2] *= ratio
            geom.size, geom.pos = size, place


def _set_floor(spec: mujoco.MjSpec, friction: tuple[float, ...] | None) -> None:
    """Set the sliding friction of floor and soles: in a contact the larger one counts."""
    if friction is None:
        return
    for geom in spec.geoms:
        if geom.name == "floor" or "foot_point" in geom.name:
            geom.friction = [friction[0], *geom.friction[1:]]


def _below(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """Return a body's descendants, and for the root of the robot itself too."""
    found = [body] if body.name == "pelvis" else []
    for child in body.bodies:
        found += [child, *_below(child)]
    return found
