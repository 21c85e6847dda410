"""The command of the whole-body controller (= the action of a policy): 23 numbers, their names, units and bounds.

``(vx, vy, yaw rate, h, r, p, y, q_upper)`` as in the paper's "Low-Level Whole-body Controller", and two grippers.
Velocities are in the pelvis heading frame; ``torso_height`` is the height of the pelvis origin above the floor; torso
roll and pitch are those of ``torso_link`` against gravity, torso yaw is against the pelvis.
"""

import numpy as np

from gym_demohlm.errors import CommandError
from gym_demohlm.robot import g1

NAMES: tuple[str, ...] = (
    "base_x.vel",
    "base_y.vel",
    "base_yaw.vel",
    "torso_height.pos",
    "torso_roll.pos",
    "torso_pitch.pos",
    "torso_yaw.pos",
    *(f"{joint}.pos" for joint in g1.ARM_JOINTS),
    "left_gripper.pos",
    "right_gripper.pos",
)
SIZE = len(NAMES)
VELOCITY = slice(0, 3)
HEIGHT, ROLL, PITCH, YAW = 3, 4, 5, 6
TORSO = slice(3, 7)
LEFT_ARM, RIGHT_ARM, ARMS = slice(7, 14), slice(14, 21), slice(7, 21)
GRIPPERS = slice(21, 23)

_ARM_RANGES = g1.joint_ranges(g1.read_mjcf())[len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS) :]  # (14, 2) [rad]
LOWER = np.concatenate([[-0.5, -0.4, -1.0, 0.40, -0.4, -0.3, -1.0], _ARM_RANGES[:, 0], [0.0, 0.0]])
UPPER = np.concatenate([[0.8, 0.4, 1.0, 0.76, 0.4, 1.2, 1.0], _ARM_RANGES[:, 1], [1.0, 1.0]])
for _bound in (LOWER, UPPER):
    _bound.setflags(write=False)


def rest() -> np.ndarray:
    """Return the command of a robot at rest, (23,): no velocity, torso upright, arms at home, grippers open."""
    command = np.zeros(SIZE)
    command[HEIGHT] = g1.PELVIS_HEIGHT
    command[ARMS] = g1.HOME[len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS) :]
    return command


def validate(commands: np.ndarray, num_worlds: int) -> np.ndarray:
    """Return the commands as float64 (num_worlds, 23).

    Raises:
        CommandError: The shape is another, or a number is not finite.
    """
    array = np.asarray(commands, dtype=np.float64)
    if array.shape != (num_worlds, SIZE):
        raise CommandError(
            f"a command of shape {array.shape}", f"({num_worlds}, {SIZE})", "give one row of 23 numbers a world"
        )
    if not np.isfinite(array).all():
        bad = sorted({NAMES[column] for column in np.nonzero(~np.isfinite(array))[1]})
        raise CommandError(f"NaN or infinity in {', '.join(bad)}", "finite numbers", "check what computed the command")
    return array


def clip(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bring commands into their bounds.

    Args:
        commands: (N, 23).

    Returns:
        The clipped commands (N, 23), and how many numbers of each were out of bounds, beyond float32 rounding (N,).
    """
    clipped = np.clip(commands, LOWER, UPPER)
    return clipped, (np.abs(clipped - commands) > 1e-6).sum(axis=1)
