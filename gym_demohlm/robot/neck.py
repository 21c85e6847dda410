"""The G1 with its fixed head -> the G1 with a neck of two servos (yaw, then pitch) and a RealSense D435.

Frames: the site ``head_camera`` sits at the camera's colour lens with x forward (out of the lens), y left, z up. The
MuJoCo camera ``head`` is at the same point; MuJoCo cameras look along their own -z with y up. Positive pitch looks
down, positive yaw looks left; at zero the camera looks along the torso's x axis.

Colour lens: 69.4 x 42.5 degrees at 16:9 (Intel RealSense D400 series data sheet, 337029, "RGB camera"). At 640 x 480
the stream is a crop of the sensor's width, so its vertical field of view stays 42.5 degrees (54.8 horizontal). The
lens sits in the middle of the housing here, 32 mm from its true place, so that the robot stays mirror-symmetric.
"""

import math

import mujoco
import numpy as np

from gym_demohlm.arithmetic import dot, eigh
from gym_demohlm.robot import dynamixel, g1

NECK_JOINTS = ("neck_yaw", "neck_pitch")
NECK_LOWER = np.array([-1.57, -0.70])  # rad
NECK_UPPER = np.array([1.57, 1.40])  # rad: 80 degrees down, to see an object at the feet
CAMERA_WIDTH, CAMERA_HEIGHT = 640, 480  # px
CAMERA_FOVY = 42.5  # degrees
CAMERA_FOVX = math.degrees(2 * math.atan(math.tan(math.radians(CAMERA_FOVY) / 2) * CAMERA_WIDTH / CAMERA_HEIGHT))
for _bound in (NECK_LOWER, NECK_UPPER):
    _bound.setflags(write=False)

YAW_POSITION = (0.018, 0.0, 0.325)  # m, the yaw axis in the torso frame, at the rim of the neck opening
PITCH_POSITION = (0.0, 0.0, 0.075)  # m, the pitch axis in the yaw frame
_CAMERA_SIZE = (0.025, 0.090, 0.025)  # m, D435 housing
_CAMERA_MASS = 0.072  # kg
_CAMERA_POS = (0.030, 0.0, 0.022)  # m, housing centre in the pitch frame
LENS_POSITION = (_CAMERA_POS[0] + _CAMERA_SIZE[0] / 2 + 0.002, 0.0, _CAMERA_POS[2])  # m, head_camera in the pitch frame
_MOVING_COM = np.array([0.015, 0.0, 0.078])  # m, of both moving parts in the yaw frame, at zero angles
_BRACKET_MASS = 0.030  # kg each, printed PLA, estimated
_NATURAL_FREQUENCY = 60.0  # rad/s of the servos' position loop: ten times the gaze controller's bandwidth


def add_neck(spec: mujoco.MjSpec) -> None:
    """Replace the head by the neck and its camera, in place, without actuators.

    The mass of the moving parts is taken from the torso, at the place of the head. So part of the head (1.04 kg) is
    replaced, its electronics stay, and the robot's mass and balance remain those that Unitree publishes.
    """
    torso = spec.body("torso_link")
    for geom in list(torso.geoms):
        if geom.meshname == "head_link" or geom.name == "head_collision":
            spec.delete(geom)
    white, dark, metal = [0.92, 0.92, 0.93, 1], [0.10, 0.10, 0.11, 1], [0.75, 0.76, 0.78, 1]
    _add_part(torso, "cylinder", [0.050, 0.012, 0], [YAW_POSITION[0], 0, 0.300], dark, 0.0)  # plate over the opening
    _add_part(torso, "box", [half / 2 for half in dynamixel.SIZE], [YAW_POSITION[0], 0, 0.318], dark, 0.0)

    yaw = torso.add_body(name="neck_yaw_link", pos=YAW_POSITION)
    _add_joint(yaw, "neck_yaw", [0, 0, 1], 0)
    _add_part(yaw, "cylinder", [0.016, 0.006, 0], [0, 0, 0.012], metal, 0.0)
    _add_part(yaw, "box", [0.014, 0.032, 0.003], [0, 0, 0.021], white, _BRACKET_MASS / 3)
    for side in (1, -1):
        _add_part(yaw, "box", [0.012, 0.003, 0.034], [0, side * 0.031, 0.052], white, _BRACKET_MASS / 3)
    _add_part(yaw, "box", [0.010, 0.013, 0.017], [0, 0, 0.055], dark, dynamixel.MASS)

    pitch = yaw.add_body(name="neck_pitch_link", pos=PITCH_POSITION)
    _add_joint(pitch, "neck_pitch", [0, 1, 0], 1)
    _add_part(pitch, "box", [0.012, 0.024, 0.004], [0.006, 0, 0.012], white, _BRACKET_MASS)
    _add_part(pitch, "box", [length / 2 for length in _CAMERA_SIZE], _CAMERA_POS, metal, _CAMERA_MASS)
    lens_x = _CAMERA_POS[0] + _CAMERA_SIZE[0] / 2
    _add_part(pitch, "box", [0.001, 0.042, 0.010], [lens_x, 0, _CAMERA_POS[2]], dark, 0.0)
    for y in (-0.030, 0.0, 0.030):
        lens = _add_part(pitch, "cylinder", [0.006, 0.001, 0], [lens_x + 0.001, y, _CAMERA_POS[2]], metal, 0.0)
        lens.quat = [math.sqrt(0.5), 0, math.sqrt(0.5), 0]
    head = pitch.add_geom(name="head_collision", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.045, 0, 0], mass=0.0)
    head.pos = [_CAMERA_POS[0] - 0.01, 0, _CAMERA_POS[2]]
    head.contype, head.conaffinity, head.condim, head.group = g1.ROBOT_BIT, g1.WORLD_BIT, 3, 3

    pitch.add_site(name="head_camera", pos=LENS_POSITION, size=[0.005, 0.005, 0.005], group=5)
    camera = pitch.add_camera(
        name="head", pos=LENS_POSITION, fovy=CAMERA_FOVY, resolution=[CAMERA_WIDTH, CAMERA_HEIGHT]
    )
    camera.quat = [0.5, 0.5, -0.5, -0.5]  # camera x = -y, y = z, -z = x of the site
    moving_mass = 2 * _BRACKET_MASS + dynamixel.MASS + _CAMERA_MASS
    _take_mass(torso, moving_mass, np.array(YAW_POSITION) + _MOVING_COM)


def add_neck_actuators(spec: mujoco.MjSpec) -> None:
    """Add the servos ``neck_yaw`` and ``neck_pitch``: critically damped, limited to the stall torque at 5 V."""
    inertia = dynamixel.ARMATURE + _CAMERA_MASS * _CAMERA_POS[0] ** 2
    stiffness = inertia * _NATURAL_FREQUENCY**2
    damping = max(2 * inertia * _NATURAL_FREQUENCY - dynamixel.BACK_EMF_DAMPING, 0.0)
    for name in NECK_JOINTS:
        g1.add_position_actuator(spec, name, f"{name}_joint", stiffness, damping, dynamixel.STALL_TORQUE)


def _add_joint(body: mujoco.MjsBody, name: str, axis: list[float], index: int) -> None:
    joint = body.add_joint(name=f"{name}_joint", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [NECK_LOWER[index], NECK_UPPER[index]]
    joint.armature, joint.damping[0] = dynamixel.ARMATURE, dynamixel.BACK_EMF_DAMPING


def _add_part(
    body: mujoco.MjsBody,
    shape: str,
    size: list[float],
    pos: tuple[float, ...] | list[float],
    rgba: list[float],
    mass: float,
) -> mujoco.MjsGeom:
    """Add a primitive that is visible and has mass, but never collides."""
    kind = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}[shape]
    return body.add_geom(type=kind, size=size, pos=pos, rgba=rgba, mass=mass, group=2, contype=0, conaffinity=0)


def _take_mass(body: mujoco.MjsBody, mass: float, position: np.ndarray) -> None:
    """Take a point mass [kg] at a position in the body frame [m] out of a body's inertia."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.array(body.iquat))
    R_body_inertia = rotation.reshape(3, 3)
    com = np.array(body.ipos)

    def spread(offset: np.ndarray) -> np.ndarray:
        return dot(offset, offset) * np.eye(3) - np.outer(offset, offset)

    about_origin = R_body_inertia @ np.diag(body.inertia) @ R_body_inertia.T + body.mass * spread(com)
    rest = body.mass - mass
    new_com = (body.mass * com - mass * position) / rest
    inertia = about_origin - mass * spread(position) - rest * spread(new_com)
    moments, axes = eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # right-handed
    quat_wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(quat_wxyz, axes.reshape(9))
    body.mass, body.ipos, body.iquat, body.inertia = rest, new_com, quat_wxyz, moments
