"""The G1 with its stock hands -> the G1 with contact pads on its rubber hands, or with parallel grippers.

Both hands define the site ``<side>_palm``, the end-effector frame: x along the fingers, axes parallel to the
``<side>_wrist_yaw_link`` frame, so that with the arms pointing forward the left palm faces -y and the right palm +y.
Its origin is the centre of the rubber palm's contact face, or the point midway between the gripper's finger pads.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import mujoco

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.robot import dynamixel, g1

Hands = Literal["rubber", "gripper"]
HANDS: tuple[str, ...] = get_args(Hands)

HARD = ((0.004, 1.0), (0.95, 0.99, 0.001))  # MuJoCo's solref and solimp of fingers and of the core of a palm
_HAND_OBSTACLES = ("pelvis", "torso", "left_thigh", "right_thigh", "left_shin", "right_shin")  # + "_collision"


@dataclass(frozen=True, kw_only=True)
class RubberPalm:
    """Contact model of a rubber hand: one box between the plane that thumb and finger tips touch and its back.

    The mesh of the hand reaches 0.045 m from the wrist axis with its curled finger tips, 0.026 m with its thumb and
    0.010 m with its palm. Rubber yields, so a flat face at the finger tips represents the hand pressed against an
    object. The face is toed in, like the curled hand, and becomes parallel when the wrist yields to the squeeze. It is
    soft by a few millimetres, so that all of it bears at once. Below is a hard core, on which a robot can lean.

    Attributes:
        face_center: Centre of the left hand's face in the wrist-yaw frame [m]; the right hand's is mirrored.
        toe_in: Turn of the box about the hand's z axis, finger tips towards the object [rad].
        half_size: Half lengths of the box [m].
        friction: Sliding, torsional [m] and rolling [m] friction; the torsional one is that of a patch of 3 cm radius.
        solref, solimp: MuJoCo's contact softness of the rubber.
        thickness: Thickness of the rubber over the core [m]. The core is as hard as a gripper's finger.
    """

    face_center: tuple[float, float, float] = (0.107, -0.045, 0.0)
    toe_in: float = 0.06
    half_size: tuple[float, float, float] = (0.058, 0.028, 0.036)
    friction: tuple[float, float, float] = (1.2, 0.025, 0.0005)
    solref: tuple[float, float] = (0.0065, 1.0)
    solimp: tuple[float, float, float] = (0.35, 0.99, 0.01)
    thickness: float = 0.0025


@dataclass(frozen=True, kw_only=True)
class ParallelGripper:
    """A printed gripper: a housing with one servo whose pinion drives two racks, each carrying a flat finger.

    Lengths are in the wrist-yaw frame. Masses are estimates from volume: PLA housing of 40 % infill, solid fingers.

    Attributes:
        stroke: Travel of each jaw [m]. The pads of an open gripper are two strokes apart.
        pinion_radius: Radius of the pinion [m].
        current_share: Share of the stall torque the servo may hold without overheating.
        housing_start: x where the wrist ends [m].
        housing_half_size: Half lengths of the housing [m].
        housing_mass: Mass of PLA and screws, without the servo [kg].
        finger_half_size: Half lengths of a finger [m]. A finger starts where the housing ends.
        finger_mass: Mass of one finger [kg].
        stiffness: Position gain of the servo, as seen at the jaws [N/m].
        friction: Sliding, torsional [m] and rolling [m] friction of the pads.
    """

    stroke: float = 0.045
    pinion_radius: float = 0.012
    current_share: float = 0.4
    housing_start: float = 0.0415
    housing_half_size: tuple[float, float, float] = (0.0245, 0.060, 0.020)
    housing_mass: float = 0.065
    finger_half_size: tuple[float, float, float] = (0.038, 0.006, 0.012)
    finger_mass: float = 0.020
    stiffness: float = 4000.0
    friction: tuple[float, float, float] = (1.0, 0.01, 0.0005)

    @property
    def force_limit(self) -> float:
        """Force of the pinion on both racks together [N]; each pad presses with half of it."""
        return self.current_share * dynamixel.STALL_TORQUE / self.pinion_radius

    @property
    def max_speed(self) -> float:
        """No-load speed of a jaw [m/s]."""
        return dynamixel.NO_LOAD_SPEED * self.pinion_radius

    @property
    def armature(self) -> float:
        """Servo inertia seen at the racks, both together [kg]."""
        return dynamixel.ARMATURE / self.pinion_radius**2


RUBBER_PALM = RubberPalm()
GRIPPER = ParallelGripper()

# The wrist without its rubber hand (0.170 kg), from Unitree's URDF, left side; off-diagonal terms below 5e-6 left out.
_BARE_WRIST_MASS = 0.08457647  # kg
_BARE_WRIST_COM = (0.02200381568, 0.00049485096, 0.00053861123)  # m
_BARE_WRIST_INERTIA = (4.929e-05, 5.973e-05, 3.928e-05)  # kg m^2


def add_hands(spec: mujoco.MjSpec, kind: Hands) -> None:
    """Give the robot its hands, in place.

    Args:
        spec: The robot with its stock hands, from `g1.load_body_spec`.
        kind: "rubber" adds no joint. "gripper" adds, for each side, the jaw joints ``<side>_gripper_jaw_joint`` and
            ``<side>_gripper_mirror_joint`` (0 open .. stroke closed [m]) and the actuator ``<side>_gripper``, whose
            control is 0 (open) .. 1 (closed).

    Raises:
        UnknownNameError: `kind` is neither.
    """
    if kind not in HANDS:
        raise UnknownNameError("hands", str(kind), HANDS)
    for side in g1.SIDES:
        spec.delete(spec.geom(f"{side}_hand_collision"))
        spec.geom(f"{side}_wrist_collision").size[0] = 0.030  # m, the mesh's, so that palms touch first
        if kind == "rubber":
            _add_rubber_palm(spec, side, RUBBER_PALM)
        else:
            _add_gripper(spec, side, GRIPPER)
    for name in _HAND_OBSTACLES:
        spec.geom(f"{name}_collision").conaffinity |= g1.BODY_BIT


def contact_geoms(kind: Hands, side: str) -> tuple[str, ...]:
    """Return the names of the geoms with which a hand grasps."""
    if kind == "rubber":
        return (f"{side}_palm_pad", f"{side}_palm_core")
    return tuple(f"{side}_{jaw}_pad" for jaw in ("jaw", "mirror"))


def _add_rubber_palm(spec: mujoco.MjSpec, side: str, palm: RubberPalm) -> None:
    sign = 1.0 if side == "left" else -1.0
    x, y, z = palm.face_center
    depth, angle = palm.half_size[1], -sign * palm.toe_in
    wrist = spec.body(f"{side}_wrist_yaw_link")
    for name, inside, softness in (("pad", 0.0, (palm.solref, palm.solimp)), ("core", palm.thickness, HARD)):
        size = [half - inside for half in palm.half_size]
        geom = wrist.add_geom(name=f"{side}_palm_{name}", type=mujoco.mjtGeom.mjGEOM_BOX, size=size)
        geom.pos = [x - sign * depth * math.sin(angle), sign * (y + depth * math.cos(angle)), z]
        geom.quat = [math.cos(angle / 2), 0, 0, math.sin(angle / 2)]
        _make_grasping(geom)
        geom.mass, geom.friction, geom.solref, geom.solimp[:3] = 0.0, palm.friction, *softness
    spec.site(f"{side}_palm").pos = [x, sign * y, z]


def _add_gripper(spec: mujoco.MjSpec, side: str, gripper: ParallelGripper) -> None:
    sign = 1.0 if side == "left" else -1.0
    wrist = spec.body(f"{side}_wrist_yaw_link")
    for geom in list(wrist.geoms):
        if geom.meshname == f"{side}_rubber_hand":
            spec.delete(geom)
    x, y, z = _BARE_WRIST_COM
    wrist.mass, wrist.ipos, wrist.inertia = _BARE_WRIST_MASS, [x, sign * y, z], _BARE_WRIST_INERTIA
    wrist.iquat = [1, 0, 0, 0]

    housing_x, housing_y, housing_z = gripper.housing_half_size
    finger_x, finger_y, finger_z = gripper.finger_half_size
    front = gripper.housing_start + 2 * housing_x
    base = wrist.add_body(name=f"{side}_gripper_base", pos=[gripper.housing_start, 0, 0])
    grey, dark, light = [0.30, 0.30, 0.32, 1], [0.12, 0.12, 0.13, 1], [0.85, 0.86, 0.88, 1]
    _add_visual(base, "box", [0.017, 0.026, 0.022], [0.017, 0, 0], grey, gripper.housing_mass / 2)
    _add_visual(base, "box", [0.0075, housing_y, 0.014], [0.0415, 0, 0], dark, gripper.housing_mass / 2)  # rail
    _add_visual(base, "box", [half / 2 for half in dynamixel.SIZE], [0.020, 0, 0.030], dark, dynamixel.MASS)
    _add_visual(base, "cylinder", [gripper.pinion_radius, 0.003, 0], [0.0415, 0, 0.016], light, 0.0)
    housing = base.add_geom(name=f"{side}_gripper_housing", type=mujoco.mjtGeom.mjGEOM_BOX)
    housing.size, housing.pos, housing.mass = [housing_x, housing_y, housing_z], [housing_x, 0, 0], 0.0
    _make_grasping(housing)

    for jaw, jaw_sign in (("jaw", 1.0), ("mirror", -1.0)):
        offset = jaw_sign * (gripper.stroke + finger_y)
        body = base.add_body(name=f"{side}_gripper_{jaw}", pos=[front - gripper.housing_start, offset, 0])
        joint = body.add_joint(name=f"{side}_gripper_{jaw}_joint", type=mujoco.mjtJoint.mjJNT_SLIDE)
        joint.axis, joint.range = [0, -jaw_sign, 0], [0, gripper.stroke]
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.armature = gripper.armature / 2
        joint.damping[0] = gripper.force_limit / gripper.max_speed / 2
        carriage = [-0.006, 0.3 * jaw_sign * finger_y, 0]
        _add_visual(body, "box", [0.012, 0.010, 0.017], carriage, light, gripper.finger_mass / 2)
        pad = body.add_geom(name=f"{side}_{jaw}_pad", type=mujoco.mjtGeom.mjGEOM_BOX)
        _make_grasping(pad)
        pad.size, pad.pos, pad.mass = [finger_x, finger_y, finger_z], [finger_x, 0, 0], 0.0
        pad.friction, pad.solref, pad.solimp[:3] = gripper.friction, *HARD
        half = [finger_x / 2, finger_y, finger_z]
        for middle, rgba in ((finger_x / 2, light), (3 * finger_x / 2, dark)):
            _add_visual(body, "box", half, [middle, 0, 0], rgba, gripper.finger_mass / 4)
    spec.site(f"{side}_palm").pos = [front + finger_x, 0, 0]

    coupling = spec.add_equality(name=f"{side}_gripper_coupling", type=mujoco.mjtEq.mjEQ_JOINT)
    coupling.name1, coupling.name2 = f"{side}_gripper_mirror_joint", f"{side}_gripper_jaw_joint"
    coupling.objtype = mujoco.mjtObj.mjOBJ_JOINT
    coupling.data[:5], coupling.solref = [0, 1, 0, 0, 0], [0.004, 1]


def add_gripper_actuators(spec: mujoco.MjSpec) -> None:
    """Add ``left_gripper`` and ``right_gripper``: force = stiffness (stroke ctrl - q), limited, on coupled jaws."""
    for side in g1.SIDES:
        name, limit = f"{side}_gripper", GRIPPER.force_limit
        g1.add_position_actuator(spec, name, f"{side}_gripper_jaw_joint", GRIPPER.stiffness, 0.0, limit)
        actuator = spec.actuators[-1]
        actuator.gainprm[0] = GRIPPER.stiffness * GRIPPER.stroke
        actuator.ctrllimited, actuator.ctrlrange = True, [0, 1]


def _make_grasping(geom: mujoco.MjsGeom) -> None:
    """Make a geom of a hand collide with the world, the other hand, trunk and legs, with torsional friction."""
    geom.contype, geom.conaffinity = g1.ROBOT_BIT | g1.BODY_BIT, g1.WORLD_BIT | g1.BODY_BIT
    geom.condim, geom.priority, geom.group = 4, 1, 3
    geom.solref = [0.005, 1]


def _add_visual(
    body: mujoco.MjsBody, shape: str, size: list[float], pos: list[float], rgba: list[float], mass: float
) -> None:
    """Add a primitive that is visible and has mass, but never collides."""
    kind = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}[shape]
    geom = body.add_geom(type=kind, size=size, pos=pos, rgba=rgba, mass=mass, group=2)
    geom.contype, geom.conaffinity = 0, 0
