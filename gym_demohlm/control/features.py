"""What the whole-body policy sees and does: the layout of its observation and action, shared by training and run time.

Only signals that a real G1 has: gyro, gravity in the pelvis frame, joint positions and velocities, the last action, the
arm targets and how fast they move, the command, the gait clock, the velocity that leg odometry finds in them, and the
loads that the arms' servos tell.
"""

import numpy as np

from gym_demohlm.robot import g1

WRIST_JOINTS = tuple(joint for joint in g1.ARM_JOINTS if "wrist" in joint)
OBSERVED_JOINTS = tuple(joint for joint in g1.BODY_JOINTS if joint not in WRIST_JOINTS)  # 23: wrists matter little
DRIVEN_JOINTS = g1.LEG_JOINTS + g1.WAIST_JOINTS  # 15
OBSERVED_ARM_JOINTS = tuple(joint for joint in g1.ARM_JOINTS if joint not in WRIST_JOINTS)  # 8
OBSERVED_INDEX = np.array([g1.BODY_JOINTS.index(joint) for joint in OBSERVED_JOINTS])
OBSERVED_ARM_INDEX = np.array([g1.ARM_JOINTS.index(joint) for joint in OBSERVED_ARM_JOINTS])

HISTORY = 3  # control ticks, oldest first
FRAME_SIZE = 6 + 2 * len(OBSERVED_JOINTS)
ACTION_SIZE = len(DRIVEN_JOINTS)
_FIRST_SIZE = HISTORY * FRAME_SIZE + ACTION_SIZE + len(OBSERVED_ARM_JOINTS) + 7 + 3 + 2
OBSERVATION_SIZE = _FIRST_SIZE + len(OBSERVED_ARM_JOINTS) + 2
OBSERVATION_SIZES = (_FIRST_SIZE, OBSERVATION_SIZE)
"""Of controllers of this and earlier formats: new inputs come last, so that an earlier network reads fewer of them."""
ODOMETRY = slice(_FIRST_SIZE - 2, _FIRST_SIZE)
"""Where the velocity is in an observation."""
ACTION_SCALE = np.array([0.30, 0.20, 0.20, 0.35, 0.30, 0.20] * 2 + [0.20, 0.20, 0.25])  # rad for an action of 1
ACTION_LIMIT = 4.0

GYRO_SCALE, VELOCITY_SCALE, ARM_VELOCITY_SCALE = 0.25, 0.05, 0.3
COMMAND_SCALE = np.array([1, 1, 1, 5, 1, 1, 1.0])
COMMAND_OFFSET = np.array([0, 0, 0, 0.7, 0, 0, 0.0])


def gravity(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the direction of gravity in the body frame, (N, 4) -> (N, 3)."""
    w, x, y, z = quat_wxyz.T
    return np.stack([2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1], axis=1)


def frame(quat_wxyz: np.ndarray, gyro: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Return one tick of proprioception, (N, FRAME_SIZE).

    Args:
        quat_wxyz: (N, 4) pelvis orientation; only its gravity direction is used.
        gyro: (N, 3) pelvis angular velocity in the pelvis frame [rad/s].
        q: (N, 23) positions of OBSERVED_JOINTS [rad].
        dq: (N, 23) their velocities [rad/s].
    """
    return np.concatenate([GYRO_SCALE * gyro, gravity(quat_wxyz), q, VELOCITY_SCALE * dq], axis=1)


def observation(
    history: np.ndarray,
    last_action: np.ndarray,
    arm_targets: np.ndarray,
    command: np.ndarray,
    phase: np.ndarray,
    standing: np.ndarray,
    velocity: np.ndarray,
    arm_velocity: np.ndarray,
    carried: np.ndarray,
) -> np.ndarray:
    """Return the policy's observation, (N, OBSERVATION_SIZE).

    Args:
        history: (N, HISTORY * FRAME_SIZE).
        last_action: (N, 15).
        arm_targets: (N, 8) [rad].
        command: (N, 7 or more), slewed.
        phase: (N,) gait clock.
        standing: (N,) bool.
        velocity: (N, 2) from the odometry [m/s].
        arm_velocity: (N, 8) of the arm targets, which move evenly between two commands [rad/s].
        carried: (N, 2) what the hands are found to carry [kg].
    """
    walking = (~standing).astype(np.float64)
    clock = [np.sin(2 * np.pi * phase) * walking, np.cos(2 * np.pi * phase) * walking, standing.astype(np.float64)]
    command = (command[:, :7] - COMMAND_OFFSET) * COMMAND_SCALE
    arm_velocity = ARM_VELOCITY_SCALE * arm_velocity
    parts = [history, last_action, arm_targets, command, np.stack(clock, axis=1), velocity, arm_velocity, carried]
    return np.concatenate(parts, axis=1)


Mirror = tuple[list[int], list[float]]


def mirror_joints(joints: tuple[str, ...]) -> Mirror:
    """Return which joint each one is in a mirror, and its sign."""
    swap = {"left": "right", "right": "left", "waist": "waist"}
    source = [joints.index(swap[joint.split("_")[0]] + joint[len(joint.split("_")[0]) :]) for joint in joints]
    sign = [-1.0 if ("roll" in joint or "yaw" in joint) else 1.0 for joint in joints]
    return source, sign


def join(blocks: list[Mirror]) -> tuple[np.ndarray, np.ndarray]:
    """Return source and sign of blocks one after another."""
    source: list[int] = []
    sign: list[float] = []
    for block_source, block_sign in blocks:
        source += [len(source) + index for index in block_source]  # evaluated before the list grows
        sign += block_sign
    return np.array(source), np.array(sign, dtype=np.float32)


_FRAME_MIRROR = [
    ([0, 1, 2], [-1.0, 1.0, -1.0]),  # gyro
    ([0, 1, 2], [1.0, -1.0, 1.0]),  # gravity
    mirror_joints(OBSERVED_JOINTS),
    mirror_joints(OBSERVED_JOINTS),
]
COMMAND_MIRROR: Mirror = (list(range(7)), [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
_CLOCK_MIRROR: Mirror = ([0, 1, 2], [-1.0, -1.0, 1.0])  # half a period later
_VELOCITY_MIRROR: Mirror = ([0, 1], [1.0, -1.0])
SIDES_MIRROR: Mirror = ([1, 0], [1.0, 1.0])

# mirrored[:, i] = sign[i] * x[:, source[i]]: the observation and action of the robot seen in a mirror.
OBSERVATION_MIRROR = join(
    _FRAME_MIRROR * HISTORY
    + [
        mirror_joints(DRIVEN_JOINTS),
        mirror_joints(OBSERVED_ARM_JOINTS),
        COMMAND_MIRROR,
        _CLOCK_MIRROR,
        _VELOCITY_MIRROR,
        mirror_joints(OBSERVED_ARM_JOINTS),
        SIDES_MIRROR,
    ]
)
ACTION_MIRROR = join([mirror_joints(DRIVEN_JOINTS)])


def mirror(values: np.ndarray, table: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Mirror rows left to right, (N, D) -> (N, D)."""
    source, sign = table
    return values[:, source] * sign


def no_mirror(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return source and sign of numbers that stay as they are: of a policy that was trained without the mirror."""
    return np.arange(size), np.ones(size, dtype=np.float32)


def first_inputs(table: tuple[np.ndarray, np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mirror of the first inputs of an observation: of an earlier format, see ``OBSERVATION_SIZES``."""
    source, sign = table
    return source[:count], sign[:count]
