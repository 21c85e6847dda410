"""How an object lay, or roughly lies -> the orientations from which a tracker looks for it."""

import math

import numpy as np

from gym_demohlm import poses

NUM_STARTS = 24


def starts(R_odom_object: np.ndarray | None, known: bool) -> list[np.ndarray]:
    """Return orientations (3, 3) in odometry coordinates to start from.

    Args:
        R_odom_object: (3, 3) how the object lay; roughly how it lies, within a right angle; or None.
        known: Whether it was seen to lie like that.
    """
    if R_odom_object is None:
        return [_about_z(2.0 * math.pi * k / NUM_STARTS) for k in range(NUM_STARTS)]
    if not known:
        return [_about_z(angle) @ R_odom_object for angle in np.linspace(-math.pi / 2, math.pi / 2, NUM_STARTS)]
    tilts = [np.zeros(3), *(angle * np.eye(3)[axis] for axis in range(3) for angle in (-1.0, -0.5, 0.5, 1.0))]
    near = [poses.rotation_from_vector(tilt) @ R_odom_object for tilt in tilts]
    rest = NUM_STARTS - len(near)
    return near + [_about_z(2.0 * math.pi * k / rest) for k in range(rest)]


def _about_z(angle: float) -> np.ndarray:
    """Return a turn (3, 3) about the vertical [rad]."""
    return poses.planar(0.0, 0.0, angle)[:3, :3]
