"""What a standing robot was told and what it does -> the slow correction of what it is told.

A policy leaves a constant error where its reward does not see one; integrating the error takes it away. The bounds are
small: a torso that something holds back pushes little harder with time.
"""

import numpy as np

from gym_demohlm.control import reference

RATE = 2.0  # 1/s: error that is corrected in a second, as a share of what there is of it
FADE = 2.0  # 1/s: share of the correction that is lost in a second on the way to another posture, or stepping
LIMITS = np.array([0.04, 0.08, 0.12, 0.08])  # m, rad: torso height, roll, pitch, yaw


def advance(trim: np.ndarray, told: np.ndarray, measured: np.ndarray, quiet: np.ndarray) -> np.ndarray:
    """Return the correction after one more control tick.

    Args:
        trim: (N, 4) correction of torso height [m], roll, pitch and yaw [rad].
        told: (N, 4) the same of the command, without the correction.
        measured: (N, 4) the same of the robot.
        quiet: (N,) bool, who stands and is told the same for a while.

    Returns:
        (N, 4).
    """
    further = np.clip(trim + RATE * reference.CONTROL_DT * (told - measured), -LIMITS, LIMITS)
    return np.where(quiet[:, None], further, (1 - FADE * reference.CONTROL_DT) * trim)
