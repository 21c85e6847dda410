"""The G1 -> cheap, randomised training models: feet on a floor, wrists welded, 5 ms steps."""

import mujoco
import numpy as np

from gym_demohlm.control import features
from gym_demohlm.control.arm_load import HAND
from gym_demohlm.robot import g1

TRAINING_DT = 0.005  # s: four steps a control tick, where the deployment model takes ten
SUBSTEPS = 4


def training_model(rng: np.random.Generator | None) -> mujoco.MjModel:
    """Compile a training model; with a generator, its friction, masses and gains are randomised.

    Ranges: friction 0.4-1.1, hand loads 0-2.2 kg (half of them under 0.2 kg), torso mass -0.8..+3 kg (mostly near
    nothing), torso centre of mass +-2.5 cm, stiffness +-10 %, damping +-20 %.
    """
    spec = g1.load_body_spec()
    spec.option.timestep = TRAINING_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations, spec.option.ls_iterations = 5, 8
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    for geom in list(spec.geoms):
        if "foot_point" not in geom.name:
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
        _randomise(spec, rng)
    _add_sensors(spec)
    return spec.compile()


def _randomise(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    for side in g1.SIDES:
        mass = rng.uniform(0.01, 0.2) if rng.random() < 0.5 else rng.uniform(0.2, 2.2)
        g1.add_load(spec, f"{side}_wrist_yaw_link", mass, HAND)
    torso = spec.body("torso_link")
    torso.mass += rng.uniform(-0.8, 0.8) if rng.random() < 0.7 else rng.uniform(0.8, 3.2)
    torso.ipos = torso.ipos + rng.uniform(-0.025, 0.025, 3)
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
