"""The G1 -> cheap, randomised training models: feet on a floor, wrists welded, 5 ms steps."""

from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm.control import features
from gym_demohlm.control.arm_load import HAND
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import PHYSICS, Physics

TRAINING_DT = 0.005  # s: four steps a control tick, where the deployment model takes ten
SUBSTEPS = 4
LARGEST_LOAD = 2.2  # kg, in each hand


def training_model(
    rng: np.random.Generator | None, hand_loads: tuple[float, float] | None = None, physics: Physics = PHYSICS
) -> mujoco.MjModel:
    """Compile a training model; with a generator, its friction, masses and gains are randomised.

    Ranges: friction 0.4-1.1, hand loads 0-2.2 kg, torso mass -0.8..+3 kg (mostly near nothing), torso centre of mass
    +-2.5 cm, stiffness +-10 %, damping +-20 %; dry friction of legs and waist: none in a quarter of the models, 0.3 to
    1.3 of ``Motor.dry_friction`` in the others (it costs time). Feet touch the floor and, where the physics has them
    do so, each other.

    Args:
        rng: Of what is random; without it the model is the nominal one.
        hand_loads: Left and right [kg], instead of random ones.
        physics: Of the robot.
    """
    spec = g1.load_body_spec(physics)
    spec.option.timestep = TRAINING_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations, spec.option.ls_iterations = 5, 8
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # One robot: islands of constraints and sparse matrices only cost time.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    for geom in list(spec.geoms):
        if "foot_" not in geom.name:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for joint in features.WRIST_JOINTS:
        spec.delete(spec.actuator(joint))
        spec.delete(spec.joint(f"{joint}_joint"))
    friction = 0.8 if rng is None else rng.uniform(0.4, 1.1)
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.1],
        contype=g1.WORLD_BIT,
        conaffinity=g1.ROBOT_BIT,
        friction=[friction, 0.005, 0.0001],
    )
    for geom in spec.geoms:
        geom.friction = [friction, 0.005, 0.0001]
    if rng is not None:
        _randomise(spec, rng, hand_loads or tuple(rng.uniform(0.0, LARGEST_LOAD, 2)))
    _add_sensors(spec)
    return spec.compile()


def stratified_loads(count: int, rng: np.random.Generator, largest: float = LARGEST_LOAD) -> np.ndarray:
    """Return pairs of hand loads (count, 2) up to the largest [kg] that fill the square evenly, in random order."""
    rows = max(1, int(np.sqrt(count)))
    columns = -(-count // rows)
    cells = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
    pairs = (cells + rng.random(cells.shape)) / np.array([rows, columns]) * largest
    return rng.permutation(pairs)[:count]


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A randomised model.

    Attributes:
        model: The model.
        facts: (4,) hand loads [kg], friction, mass added to the torso [kg]: what a critic may know.
    """

    model: mujoco.MjModel
    facts: np.ndarray


def variants(
    count: int, rng: np.random.Generator, physics: Physics = PHYSICS, largest_load: float = LARGEST_LOAD
) -> list[Variant]:
    """Return randomised models whose pairs of hand loads, up to the largest [kg], are stratified."""
    nominal = training_model(None, physics=physics).body("torso_link").mass[0]
    made = []
    for left, right in stratified_loads(count, rng, largest_load):
        model = training_model(rng, (float(left), float(right)), physics)
        added = model.body("torso_link").mass[0] - nominal
        made.append(Variant(model=model, facts=np.array([left, right, model.geom("floor").friction[0], added])))
    return made


def _randomise(spec: mujoco.MjSpec, rng: np.random.Generator, hand_loads: tuple[float, ...]) -> None:
    for side, mass in zip(g1.SIDES, hand_loads, strict=True):
        g1.add_load(spec, f"{side}_wrist_yaw_link", max(mass, 0.01), HAND)
    torso = spec.body("torso_link")
    torso.mass += rng.uniform(-0.8, 0.8) if rng.random() < 0.7 else rng.uniform(0.8, 3.2)
    torso.ipos = torso.ipos + rng.uniform(-0.025, 0.025, 3)
    friction = rng.uniform(0.3, 1.3) if rng.random() < 0.75 else 0.0
    for joint in features.DRIVEN_JOINTS:
        spec.joint(f"{joint}_joint").frictionloss = friction * g1.motor(joint).dry_friction
    stiffness, damping = rng.uniform(0.9, 1.1), rng.uniform(0.8, 1.2)
    for actuator in spec.actuators:
        actuator.gainprm[0] *= stiffness
        actuator.biasprm[1] *= stiffness
        actuator.biasprm[2] *= damping


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kind, of = mujoco.mjtSensor, mujoco.mjtObj
    spec.add_sensor(name="torso_quat", type=kind.mjSENS_FRAMEQUAT, objtype=of.mjOBJ_XBODY, objname="torso_link")
    for side in g1.SIDES:
        sole = f"{side}_sole"
        spec.add_sensor(name=f"{sole}_pos", type=kind.mjSENS_FRAMEPOS, objtype=of.mjOBJ_SITE, objname=sole)
        spec.add_sensor(name=f"{sole}_quat", type=kind.mjSENS_FRAMEQUAT, objtype=of.mjOBJ_SITE, objname=sole)
        spec.add_sensor(name=f"{sole}_vel", type=kind.mjSENS_FRAMELINVEL, objtype=of.mjOBJ_SITE, objname=sole)
        site = spec.site(sole)
        site.type, site.size = mujoco.mjtGeom.mjGEOM_BOX, [0.1, 0.05, 0.02]
        spec.add_sensor(name=f"{sole}_touch", type=kind.mjSENS_TOUCH, objtype=of.mjOBJ_SITE, objname=sole)
