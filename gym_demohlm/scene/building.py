"""Task and robot -> the description of a scene before it is compiled: robot, task, floor, light, contact sensors."""

import math

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import Physics
from gym_demohlm.robot.robot import robot_spec
from gym_demohlm.scene.furniture import add_picture
from gym_demohlm.task import Task
from gym_demohlm.variation import NONE, Variation
from gym_demohlm.variation.surroundings import furnish

OVERVIEW_CAMERA, OVERVIEW_FOVY = "overview", 45.0  # degrees
HAND_BODIES = {side: f"{side}_wrist_yaw_link" for side in g1.SIDES}
"""The body whose subtree is a hand, with its palm or gripper."""

_SHOT, _LEAD = np.array([0.5, 0.35, 0.0]), 11340.0  # place of the shot in a box, in half lengths; kg/m^3
CONTACT_SLOTS = 8  # the strongest contacts of a pair; their normal forces are summed
_MAX_FORCE = 2  # a contact sensor's reduction: keep the contacts with the largest force


def aim_overview(
    spec: mujoco.MjSpec,
    eye: tuple[float, float, float],
    target: tuple[float, float, float],
    body: mujoco.MjsBody | None = None,
) -> None:
    """Put the overview camera at ``eye`` and let it look at ``target``.

    Args:
        spec: The scene.
        eye: Position of the camera in the body's frame [m].
        target: Point in the middle of the picture, in the body's frame [m].
        body: Body that the camera is fixed to, such as furniture that should always be seen from one side; the world by
            default.
    """
    camera = spec.camera(OVERVIEW_CAMERA)
    if body is not None:
        spec.delete(camera)
        camera = body.add_camera(name=OVERVIEW_CAMERA, fovy=OVERVIEW_FOVY)
    camera.pos, camera.quat = eye, _look_at(np.array(eye), np.array(target))


def scene_spec(task: Task, physics: Physics | None = None, variation: Variation = NONE) -> mujoco.MjSpec:
    """Return the scene of a task before it is compiled.

    Args:
        task: The task.
        physics: Of the robot; ``gym_demohlm.robot.physics.PHYSICS`` by default.
        variation: What may differ from world to world.
    """
    spec = robot_spec(task.hands, physics)
    spec.modelname = task.name
    _add_surroundings(spec)
    task.build(spec)
    if "scene" in variation.groups:
        furnish(spec, task)
    _unbalance(spec)
    if "objects" in variation.groups:
        _load_off_centre(spec, task)
    for side, name in task.contact_pairs:
        _add_contact_sensor(spec, contact_name(side, name), HAND_BODIES[side], name)
    for first, second in task.force_pairs:
        _add_contact_sensor(spec, contact_name(first, second), first, second)
    for name in task.obstacles:
        _add_contact_sensor(spec, collision_name(name), "pelvis", name)
    return spec


def _unbalance(spec: mujoco.MjSpec) -> None:
    """Put a small lead ball into every loose box, off its middle.

    A box in exact balance on another one comes to rest with faces that are parallel to the last bit. There MuJoCo's box
    collider (3.11 and before, issue 3476) sometimes finds a contact as deep as the whole box and throws it across the
    room: 5 cm cubes on a table, once in 1500 s. A box off balance leans by about 1e-7 rad, which is enough. The ball
    makes it heavier by less than half a percent.
    """
    for body in spec.bodies:
        if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints):
            for box in body.geoms:
                if box.type == mujoco.mjtGeom.mjGEOM_BOX and (box.contype or box.conaffinity):
                    middle = poses.transform(poses.pose(box.pos, box.quat), _SHOT * box.size).tolist()
                    radius = 0.05 * min(box.size)
                    mass = 4 / 3 * math.pi * radius**3 * _LEAD
                    add_picture(body, "sphere", [radius], middle, (0, 0, 0, 0), mass)


def _load_off_centre(spec: mujoco.MjSpec, task: Task) -> None:
    """Put a gram off the middle of every loose object.

    MuJoCo lays the matrices of a body out in another way where its centre of mass is its origin. Worlds that are
    stepped together must be laid out alike, whatever the centres of mass of their objects.
    """
    for entry in task.objects:
        body = spec.body(entry.name)
        if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints):
            add_picture(body, "sphere", [1e-3], (0.01, 0.01, 0.01), (0, 0, 0, 0), 1e-3)


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    """Add floor, sky, light, the overview camera, and an image buffer of 640x480."""
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 640, 480
    visual.quality.offsamples = 0  # multisampling costs most of a frame in software
    visual.headlight.ambient, visual.headlight.diffuse = [0.35, 0.35, 0.35], [0.45, 0.45, 0.45]
    visual.map.znear, visual.quality.shadowsize, visual.map.shadowscale = 0.01, 4096, 0.4
    spec.stat.center, spec.stat.extent = [-0.2, 0.0, 0.5], 2.5  # m: what shadows and clipping planes are fitted to
    builtin = mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.86, 0.90, 0.94],
        rgb2=[0.55, 0.66, 0.76],
        width=128,
        height=768,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=[0.60, 0.62, 0.64],
        rgb2=[0.54, 0.56, 0.58],
        width=256,
        height=256,
    )
    material = spec.add_material(name="floor", texrepeat=[2, 2], texuniform=True, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    world = spec.worldbody
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[10, 10, 0.1],
        material="floor",
        contype=g1.WORLD_BIT,
        conaffinity=g1.ROBOT_BIT | g1.WORLD_BIT,
        condim=3,
        friction=[0.8, 0.005, 0.0001],
    )
    lamp = np.array([0.8, -1.6, 3.2])
    world.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        pos=lamp,
        dir=np.array([-0.3, 0.0, 0.4]) - lamp,
        cutoff=75,
        exponent=1,
        diffuse=[0.5, 0.5, 0.5],
        castshadow=True,
    )
    world.add_camera(name=OVERVIEW_CAMERA, fovy=OVERVIEW_FOVY)
    aim_overview(spec, (1.55, -1.95, 1.35), (-0.3, 0.1, 0.55))


def _add_contact_sensor(spec: mujoco.MjSpec, name: str, subtree: str, body: str) -> None:
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,  # a whole subtree
        objname=subtree,
        reftype=mujoco.mjtObj.mjOBJ_XBODY,
        refname=body,
        intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FORCE.value, _MAX_FORCE, CONTACT_SLOTS],
    )


def contact_name(first: str, second: str) -> str:
    """Return the name of the sensor of what one body bears from another."""
    return f"contact_{first}_{second}"


def collision_name(name: str) -> str:
    """Return the name of the sensor of what the robot bears from an obstacle."""
    return f"collision_{name}"


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz of a camera (x right, y up, looking along -z) at eye that looks at target."""
    back = (eye - target) / norm(eye - target)
    right = np.cross([0, 0, 1], back)
    right /= norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).flatten())
    return quat
