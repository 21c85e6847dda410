"""The MJCF of the Unitree G1 that mjlab ships -> an MjSpec with motors, point feet, palms, neck and sensors.

Motor data (rotor inertia, gears, torque and speed limits) are Unitree's, as published by mjlab; joint armature follows
from them as the rotor inertia seen through the gears. Joint names have no ``_joint`` suffix outside the MJCF.
"""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError

_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
SIDES = ("left", "right")
LEG_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in _LEG)
WAIST_JOINTS = ("waist_yaw", "waist_roll", "waist_pitch")
ARM_JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in _ARM)
BODY_JOINTS = LEG_JOINTS + WAIST_JOINTS + ARM_JOINTS

MASS = 33.34  # kg, without hands and head
PELVIS_HEIGHT = 0.74  # m above the floor, knees slightly bent
_HOME_ARM = np.array([0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0])  # rad
_MIRROR_ARM = np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
HOME_LEG = np.array([-0.41, 0.0, 0.0, 0.82, -0.41, 0.0])  # rad: soles flat, hips above the ankles
HOME = np.concatenate([HOME_LEG, HOME_LEG, np.zeros(3), _HOME_ARM, _HOME_ARM * _MIRROR_ARM])  # (29,)

# Legs, measured from the MJCF: a planar two-link leg.
THIGH_LENGTH = 0.3366  # m, hip pitch axis to knee
SHANK_LENGTH = 0.3000  # m, knee to ankle pitch axis
HIP_DROP = 0.1027  # m, hip pitch axis below the pelvis origin
HIP_SPREAD = 0.1165  # m, hip roll axis left or right of the pelvis origin
SOLE_DROP = 0.0526  # m, sole below the ankle pitch axis
FOOT_POINTS = ((-0.05, 0.025), (-0.05, -0.025), (0.12, 0.03), (0.12, -0.03))  # m, in the ankle-roll frame
FOOT_POINT_RADIUS = 0.005  # m

# Collision groups as bits. Geoms collide where one's contype meets the other's conaffinity.
ROBOT_BIT, WORLD_BIT = 1, 2


def _planetary_inertia(rotor: tuple[float, float, float], gears: tuple[float, float, float]) -> float:
    """Inertia [kg m^2] of a two-stage planetary drive at its output: each stage's inertia times its ratio squared."""
    total = gears[1] * gears[2]
    return rotor[0] * total**2 + rotor[1] * gears[2] ** 2 + rotor[2]


@dataclass(frozen=True, kw_only=True)
class Motor:
    """One kind of joint drive.

    Attributes:
        armature: Rotor inertia at the joint [kg m^2].
        torque_limit: [Nm].
        stiffness: Position gain of the joint PD [Nm/rad].
        damping: Velocity gain of the joint PD [Nms/rad].
    """

    armature: float
    torque_limit: float
    stiffness: float
    damping: float


_A5020 = _planetary_inertia((0.139e-4, 0.017e-4, 0.169e-4), (1, 1 + 46 / 18, 1 + 56 / 16))
_A7520_14 = _planetary_inertia((0.489e-4, 0.098e-4, 0.533e-4), (1, 4.5, 1 + 48 / 22))
_A7520_22 = _planetary_inertia((0.489e-4, 0.109e-4, 0.738e-4), (1, 4.5, 5))
_A4010 = _planetary_inertia((0.068e-4, 0.0, 0.0), (1, 5, 5))

# Gains: stiff enough that the reference pose under gravity sags by less than 0.1 rad, damped to 0.3-1 of critical
# for the inertia of the links they move. Ankles and the lower waist are driven by two 5020 motors side by side.
_MOTORS: tuple[tuple[str, Motor], ...] = (
    (r"hip_(pitch|yaw)$", Motor(armature=_A7520_14, torque_limit=88.0, stiffness=150.0, damping=4.0)),
    (r"hip_roll$", Motor(armature=_A7520_22, torque_limit=139.0, stiffness=150.0, damping=4.0)),
    (r"knee$", Motor(armature=_A7520_22, torque_limit=139.0, stiffness=200.0, damping=5.0)),
    (r"ankle_(pitch|roll)$", Motor(armature=2 * _A5020, torque_limit=50.0, stiffness=40.0, damping=2.0)),
    (r"waist_yaw$", Motor(armature=_A7520_14, torque_limit=88.0, stiffness=250.0, damping=5.0)),
    (r"waist_(roll|pitch)$", Motor(armature=2 * _A5020, torque_limit=50.0, stiffness=250.0, damping=5.0)),
    (r"shoulder_(pitch|roll)$", Motor(armature=_A5020, torque_limit=25.0, stiffness=200.0, damping=4.0)),
    (r"(shoulder_yaw|elbow)$", Motor(armature=_A5020, torque_limit=25.0, stiffness=150.0, damping=3.0)),
    (r"wrist_roll$", Motor(armature=_A5020, torque_limit=25.0, stiffness=60.0, damping=1.5)),
    (r"wrist_(pitch|yaw)$", Motor(armature=_A4010, torque_limit=5.0, stiffness=60.0, damping=1.5)),
)


def motor(joint: str) -> Motor:
    """Return the drive of a body joint (name without ``_joint``)."""
    for pattern, kind in _MOTORS:
        if re.search(pattern, joint):
            return kind
    raise SceneError(f"joint {joint!r}", f"one of {', '.join(BODY_JOINTS)}", "check the spelling")


def mjcf_path() -> Path:
    """Return the path of the G1's MJCF inside the installed mjlab package, without importing it."""
    found = importlib.util.find_spec("mjlab")
    roots = list(found.submodule_search_locations or []) if found else []
    for root in roots:
        path = Path(root) / "asset_zoo" / "robots" / "unitree_g1" / "xmls" / "g1.xml"
        if path.exists():
            return path
    raise SceneError("no G1 description", "the file g1.xml of the mjlab package", "install mjlab>=1.0")


def read_mjcf() -> mujoco.MjSpec:
    """Return the G1's MJCF as mjlab ships it."""
    return mujoco.MjSpec.from_file(str(mjcf_path()))


def joint_ranges(spec: mujoco.MjSpec) -> np.ndarray:
    """Return the limits of the body joints, (29, 2) [rad]."""
    return np.array([spec.joint(f"{joint}_joint").range for joint in BODY_JOINTS])


def load_body_spec() -> mujoco.MjSpec:
    """Read the G1 and give it motors and feet: 29 position actuators named as the joints, no sensors, no hands.

    The MJCF's seven capsules a foot become four points, which cost less than half the time; its other collision
    geoms collide with the world, not with one another.
    """
    spec = read_mjcf()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in list(spec.geoms):
        if re.fullmatch(r"(left|right)_foot\d_collision", geom.name):
            spec.delete(geom)
        elif geom.name.endswith("_collision"):
            geom.contype, geom.conaffinity, geom.condim = ROBOT_BIT, WORLD_BIT, 3
    for side in SIDES:
        foot = spec.body(f"{side}_ankle_roll_link")
        for index, (x, y) in enumerate(FOOT_POINTS):
            foot.add_geom(
                name=f"{side}_foot_point_{index}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[FOOT_POINT_RADIUS, 0, 0],
                pos=[x, y, FOOT_POINT_RADIUS - 0.035],
                contype=ROBOT_BIT,
                conaffinity=WORLD_BIT,
                condim=3,
                friction=[0.8, 0.005, 0.0001],
                group=3,
                mass=0,
            )
        foot.add_site(name=f"{side}_sole", pos=[0.035, 0, -0.035], size=[0.01, 0.01, 0.01], group=5)
    for joint in BODY_JOINTS:
        drive = motor(joint)
        element = spec.joint(f"{joint}_joint")
        element.armature, element.frictionloss = drive.armature, 0.0
        add_position_actuator(spec, joint, f"{joint}_joint", drive.stiffness, drive.damping, drive.torque_limit)
    return spec


def add_load(spec: mujoco.MjSpec, body: str, mass: float, position: tuple[float, float, float]) -> None:
    """Fix a small weight to a body: one of its own, because a geom adds no mass to a body with explicit inertia.

    Args:
        spec: To change.
        body: Name of the body that carries it.
        mass: [kg].
        position: In the body's frame [m].
    """
    load = spec.body(body).add_body(pos=position, mass=mass, explicitinertial=True)
    load.ipos = (0.0, 0.0, 0.0)  # else it would be the body's own place once more
    load.inertia = np.full(3, 0.4 * mass * 0.03**2)  # a ball of 3 cm


def add_position_actuator(
    spec: mujoco.MjSpec, name: str, joint: str, stiffness: float, damping: float, force_limit: float
) -> None:
    """Add a PD servo to a joint: force = stiffness (ctrl - q) - damping dq, within +-force_limit."""
    actuator = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.gainprm[0] = stiffness
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.biasprm[1], actuator.biasprm[2] = -stiffness, -damping
    actuator.forcelimited, actuator.forcerange = True, [-force_limit, force_limit]
