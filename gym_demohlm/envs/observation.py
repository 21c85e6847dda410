"""Simulation -> the observation of a policy: 68 numbers of the robot, and 9 a tracked object in the camera's frame.

``FEATURES`` says what each number is; the names are those of the dataset. An object's orientation is given by the first
two columns of its rotation matrix, which, unlike a quaternion, never jump sign. A symmetric object's pose is the
equivalent one nearest the camera's heading, as a tracker's would be: one state, one observation.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.equivalents import nearest_equivalent
from gym_demohlm.robot import g1
from gym_demohlm.robot.neck import NECK_JOINTS
from gym_demohlm.robot.robot import GRIPPER_JOINTS
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One number of an observation.

    Attributes:
        name: As in a dataset, ending in ".pos" or ".vel".
        unit: rad, m, rad/s, m/s, or 1 for an entry of a rotation matrix.
        frame: What it is relative to.
    """

    name: str
    unit: str
    frame: str


def _joint_features() -> tuple[Feature, ...]:
    revolute = (*g1.BODY_JOINTS, *NECK_JOINTS)
    positions = [Feature(name=f"{joint}.pos", unit="rad", frame="joint zero") for joint in revolute]
    positions += [Feature(name=f"{joint}.pos", unit="m", frame="jaw open") for joint in GRIPPER_JOINTS]
    velocities = [Feature(name=f"{joint}.vel", unit="rad/s", frame="joint") for joint in revolute]
    velocities += [Feature(name=f"{joint}.vel", unit="m/s", frame="jaw") for joint in GRIPPER_JOINTS]
    return (*positions, *velocities)


STATE_FEATURES: tuple[Feature, ...] = (
    *_joint_features(),
    Feature(name="torso_roll.pos", unit="rad", frame="gravity, heading removed"),
    Feature(name="torso_pitch.pos", unit="rad", frame="gravity, heading removed"),
)
STATE_NAMES: tuple[str, ...] = tuple(feature.name for feature in STATE_FEATURES)
OBJECT_SIZE = 9  # numbers a tracked object


def environment_features(task: Task) -> tuple[Feature, ...]:
    """Return what the numbers of ``environment_state`` are: 9 for each of the task's objects, in their order."""
    frame = "head_camera: x forward, y left, z up"
    features = []
    for entry in task.objects:
        features += [Feature(name=f"{entry.name}_{axis}.pos", unit="m", frame=frame) for axis in "xyz"]
        entries = [f"r{row}{column}" for column in (1, 2) for row in (1, 2, 3)]
        features += [Feature(name=f"{entry.name}_{entry_name}.pos", unit="1", frame=frame) for entry_name in entries]
    return tuple(features)


def environment_names(task: Task) -> tuple[str, ...]:
    """Return the names of the numbers of ``environment_state``."""
    return tuple(feature.name for feature in environment_features(task))


def agent_pos(sim: Simulation) -> np.ndarray:
    """Return what the robot senses of itself, (N, 68) float32, see STATE_FEATURES."""
    roll_pitch_yaw = poses.rpy(sim.pose("torso")[:, :3, :3])
    positions, velocities = sim.sensed_joints()
    columns = [
        positions,
        sim.neck_positions,
        sim.gripper_positions,
        velocities,
        sim.neck_velocities,
        sim.gripper_velocities,
        roll_pitch_yaw[:, :2],
    ]
    return np.concatenate(columns, axis=1).astype(np.float32)


def environment_state(sim: Simulation) -> np.ndarray:
    """Return the tracked objects in the camera's frame, (N, 9k) float32, see environment_features."""
    T_world_camera = sim.pose("head_camera")
    T_camera_world = poses.invert(T_world_camera)
    columns = []
    for entry in sim.task.objects:
        T_camera_object = T_camera_world @ nearest_equivalent(sim.pose(entry.name), entry, T_world_camera)
        columns += [T_camera_object[:, :3, 3], T_camera_object[:, :3, 0], T_camera_object[:, :3, 1]]
    return np.concatenate(columns, axis=1).astype(np.float32)
