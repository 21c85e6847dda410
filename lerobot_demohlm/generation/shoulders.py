"""A palm's way close to its own shoulder -> a way in front of it, where the arm has room to fold.

In R4 a board stands up to 20 cm higher than the demonstrated one. A way that led below the shoulder then leads past it.
An arm that is folded to its end turns its elbow outwards; from there inverse kinematics does not find back, bends the
torso instead, and the robot loses its balance.
"""

import numpy as np

from gym_demohlm.arithmetic import norm


def before_shoulder(path: np.ndarray, p_shoulder: np.ndarray, ahead: np.ndarray, clear_m: float) -> np.ndarray:
    """Return a palm's way (T, 4, 4), moved straight ahead where it comes too close to the shoulder or is behind that.

    Args:
        path: (T, 4, 4) poses of the palm in the world.
        p_shoulder: (3,) the shoulder in the world [m].
        ahead: (3,) the level unit direction in which the robot looks, in the world.
        clear_m: Distance that the palm is to keep [m].
    """
    offset = path[:, :3, 3] - p_shoulder
    depth = offset @ ahead
    aside = norm(offset - depth[:, None] * ahead)
    least = np.sqrt(np.maximum(clear_m**2 - aside**2, 0.0))  # ahead of the shoulder, as far aside as the palm is
    result = path.copy()
    result[:, :3, 3] += np.where(aside < clear_m, np.maximum(least - depth, 0.0), 0.0)[:, None] * ahead
    return result
