"""What a robot was told and what it does -> the slow correction of what it is told.

A policy leaves a constant error where its reward does not see one; integrating the error takes it away, of the torso
while it stands and of the turning while it walks. Policies are trained without it. The bounds are small and the rate is
slow: a torso that something holds back pushes little harder with time, and whoever leads the hands is quicker.
"""

import numpy as np

from gym_demohlm.control.settings import Trim
from gym_demohlm.timing import CONTROL_DT


def advance(
    trim: np.ndarray, told: np.ndarray, measured: np.ndarray, constant: np.ndarray, settings: Trim
) -> np.ndarray:
    """Return the correction after one more control tick.

    Args:
        trim: (N, 5) correction of yaw rate [rad/s], torso height [m], roll, pitch and yaw [rad].
        told: (N, 5) the same of the command, without the correction.
        measured: (N, 5) the same of the robot.
        constant: (N, 5) bool, what a robot is asked for and told the same for a while.
        settings: Its rate and bounds.

    Returns:
        (N, 5).
    """
    limits = np.array(settings.limits)
    further = np.clip(trim + settings.rate * CONTROL_DT * (told - measured), -limits, limits)
    return np.where(constant, further, (1 - settings.fade * CONTROL_DT) * trim)
