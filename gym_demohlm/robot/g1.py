"""The MJCF of the Unitree G1 from mjlab -> an MjSpec with motors and point feet.

Motor data (rotor inertia, gears, torque limits) are Unitree's, as published by mjlab; joint armature follows from them
as the rotor inertia seen through the gears. Dry friction and peak torque are those of Unitree's unitree_rl_lab
(``unitree_actuators.py``: Fs and Y1 of N7520-14.3, N7520-22.5, N5020-16 and W4010-25). There, torque falls from a speed
X1 on (14.5 rad/s in the knee, 15.3 in the wrist, 22.6 to 30.9 elsewhere); this robot does not get that fast: of 24
loaded robots, pushed for 12 s amid commands from the whole range, no joint turned faster than 13.5 (knee), 11.8 (ankle)
and 11.2 rad/s (wrist). So the peak torque is all that is left of the torque-speed line. Outside the MJCF, joint names
have no ``_joint`` suffix.
"""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.robot.physics import PHYSICS, Physics

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
BODY_BIT = 4  # of parts of the robot against one another
FOOT_BOX = (0.085, 0.03, 0.01)  # m, half of it


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
        dry_friction: Torque that it takes to start turning it [Nm].
        peak_torque: What it gives while it turns that way, up to half of its no-load speed and more [Nm].
    """

    armature: float
    torque_limit: float
    stiffness: float
    damping: float
    dry_friction: float
    peak_torque: float


@dataclass(frozen=True, kw_only=True)
class _Drive:
    """A motor with its gears; see ``Motor``."""

    armature: float
    torque_limit: float
    dry_friction: float
    peak_torque: float

    def twice(self) -> "_Drive":
        """Return two of them side by side."""
        return _Drive(**{name: 2 * value for name, value in vars(self).items()})


_N5020 = _Drive(
    armature=_planetary_inertia((0.139e-4, 0.017e-4, 0.169e-4), (1, 1 + 46 / 18, 1 + 56 / 16)),
    torque_limit=25.0,
    dry_friction=0.6,
    peak_torque=24.8,
)
_N7520_14 = _Drive(
    armature=_planetary_inertia((0.489e-4, 0.098e-4, 0.533e-4), (1, 4.5, 1 + 48 / 22)),
    torque_limit=88.0,
    dry_friction=1.6,
    peak_torque=71.0,
)
_N7520_22 = _Drive(
    armature=_planetary_inertia((0.489e-4, 0.109e-4, 0.738e-4), (1, 4.5, 5)),
    torque_limit=139.0,
    dry_friction=2.4,
    peak_torque=111.0,
)
_W4010 = _Drive(
    armature=_planetary_inertia((0.068e-4, 0.0, 0.0), (1, 5, 5)), torque_limit=5.0, dry_friction=0.6, peak_torque=4.8
)

# Stiffness and damping: stiff enough that the reference pose under gravity sags by less than 0.1 rad, damped to 0.3-1
# of critical for the inertia of the links they move. Two 5020 motors side by side drive ankles and the lower waist.
_JOINTS: tuple[tuple[str, _Drive, float, float], ...] = (
    (r"hip_(pitch|yaw)$", _N7520_14, 150.0, 4.0),
    (r"hip_roll$", _N7520_22, 150.0, 4.0),
    (r"knee$", _N7520_22, 200.0, 5.0),
    (r"ankle_(pitch|roll)$", _N5020.twice(), 40.0, 2.0),
    (r"waist_yaw$", _N7520_14, 250.0, 5.0),
    (r"waist_(roll|pitch)$", _N5020.twice(), 250.0, 5.0),
    (r"shoulder_(pitch|roll)$", _N5020, 200.0, 4.0),
    (r"(shoulder_yaw|elbow)$", _N5020, 150.0, 3.0),
    (r"wrist_roll$", _N5020, 60.0, 1.5),
    (r"wrist_(pitch|yaw)$", _W4010, 60.0, 1.5),
)


def motor(joint: str) -> Motor:
    """Return the drive of a body joint (name without ``_joint``)."""
    for pattern, drive, stiffness, damping in _JOINTS:
        if re.search(pattern, joint):
            return Motor(**vars(drive), stiffness=stiffness, damping=damping)
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


def load_body_spec(physics: Physics | None = None) -> mujoco.MjSpec:
    """Read the G1 and give it motors and feet: 29 position actuators named as the joints, no sensors, no hands.

    Each foot gets four contact points instead of the MJCF's seven capsules, which takes less than half the time. The
    other collision geoms collide with the world, and with each other where the physics says so, the feet as boxes.

    Args:
        physics: ``PHYSICS`` by default.
    """
    physics = physics or PHYSICS
    spec = read_mjcf()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in list(spec.geoms):
        if re.fullmatch(r"(left|right)_foot\d_collision", geom.name):
            spec.delete(geom)
        elif geom.name.endswith("_collision"):
            geom.contype, geom.conaffinity, geom.condim = ROBOT_BIT, WORLD_BIT, 3
            if physics.self_collision:
                geom.contype, geom.conaffinity = ROBOT_BIT | BODY_BIT, WORLD_BIT | BODY_BIT
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
        if physics.self_collision:
            box = foot.add_geom(name=f"{side}_foot_collision", type=mujoco.mjtGeom.mjGEOM_BOX, size=FOOT_BOX)
            box.pos, box.mass, box.group, box.condim = [0.035, 0.0, -0.02], 0.0, 3, 3
            box.contype = box.conaffinity = BODY_BIT
        foot.add_site(name=f"{side}_sole", pos=[0.035, 0, -0.035], size=[0.01, 0.01, 0.01], group=5)
    for joint in BODY_JOINTS:
        drive = motor(joint)
        element = spec.joint(f"{joint}_joint")
        element.armature = drive.armature
        element.frictionloss = drive.dry_friction if physics.dry_friction and joint not in ARM_JOINTS else 0.0
        torque = drive.peak_torque if physics.peak_torque else drive.torque_limit
        add_position_actuator(spec, joint, f"{joint}_joint", drive.stiffness, drive.damping, torque)
    return spec


def add_load(spec: mujoco.MjSpec, body: str, mass: float, position: tuple[float, float, float]) -> None:
    """Fix a small weight to a body, as a body of its own: a geom adds no mass to a body with explicit inertia.

    Args:
        spec: To change.
        body: Name of the body that carries it.
        mass: [kg].
        position: In the body's frame [m].
    """
    load = spec.body(body).add_body(pos=position, mass=mass, explicitinertial=True)
    load.ipos = (0.0, 0.0, 0.0)  # the default would apply the body's position twice
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
