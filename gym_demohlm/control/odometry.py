"""Joint positions and velocities, gravity and gyro -> how fast the pelvis moves over the foot that stands.

Leg odometry: the lower foot is taken to be planted, so the pelvis moves opposite to it. Only signals of a real G1.
"""

from typing import NamedTuple

import numpy as np

from gym_demohlm.arithmetic import arccos, arctan2
from gym_demohlm.robot import g1

_Vector = tuple[np.ndarray, np.ndarray, np.ndarray]
FILTER = 0.4  # share of the new value in each tick's average: a time constant of about 40 ms
HEIGHT_BLEND = 0.03  # m: soles this far apart in height count as one planted foot, nearer ones as a mixture
EPSILON = 1e-4  # s: step of the derivative along the joint velocities


class Estimate(NamedTuple):
    """What leg odometry finds.

    Attributes:
        velocity: (N, 2) of the pelvis in its heading frame [m/s].
        sole_tilt: (N,) how far the planted sole is tipped over [rad].
        height: (N,) of the pelvis above it [m].
        over_soles: (N, 2) of the pelvis from the middle between both soles, in its heading frame [m].
    """

    velocity: np.ndarray
    sole_tilt: np.ndarray
    height: np.ndarray
    over_soles: np.ndarray


def _chain() -> tuple[list[tuple[str, np.ndarray, float]], np.ndarray]:
    """Return the left leg from hip to sole: each joint's axis, its offset from its parent [m] and fixed pitch [rad]."""
    spec = g1.read_mjcf()
    links = []
    for joint in g1.LEG_JOINTS[: len(g1.LEG_JOINTS) // 2]:
        body = spec.body(f"{joint}_link")
        axis = "xyz"[int(np.argmax(np.abs(spec.joint(f"{joint}_joint").axis)))]
        links.append((axis, np.array(body.pos), 2 * float(arctan2(body.quat[2], body.quat[0]))))
    return links, np.array([0.035, 0.0, -0.035])


LINKS, SOLE = _chain()
_POINTS = np.stack([SOLE, SOLE, SOLE + np.array([0.0, 0.0, 1.0])])[
    :, None
]  # (3, 1, 3): soles now, later, and 1 m above
_MIRROR_Y = np.array([1.0, -1.0])


def _turn(axis: str, cos: np.ndarray, sin: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> _Vector:
    if axis == "x":
        return x, cos * y - sin * z, sin * y + cos * z
    if axis == "y":
        return cos * x + sin * z, y, cos * z - sin * x
    return cos * x - sin * y, sin * x + cos * y, z


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a x b, (..., 3); NumPy's own takes longer for small arrays."""
    (ax, ay, az), (bx, by, bz) = (np.moveaxis(v, -1, 0) for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def sole_points(legs: np.ndarray, offset: np.ndarray = SOLE) -> np.ndarray:
    """Return a point of each sole in the pelvis frame.

    Args:
        legs: (..., 12) positions of ``g1.LEG_JOINTS`` [rad].
        offset: (3,) or (..., 3) the point in the ankle-roll frame [m]; the sole's middle by default.

    Returns:
        (..., 2, 3) left and right [m].
    """
    joints = np.ascontiguousarray(legs).reshape(*legs.shape[:-1], 2, len(LINKS))
    cos, sin = np.cos(joints), np.sin(joints)  # of all at once: a strided part may round otherwise
    x, y, z = (offset[..., axis, None] for axis in range(3))
    for index in range(len(LINKS) - 1, -1, -1):
        axis, position, pitch = LINKS[index]
        x, y, z = _turn(axis, cos[..., index], sin[..., index], x, y, z)
        if pitch:
            x, y, z = _turn("y", np.cos(pitch), np.sin(pitch), x, y, z)
        x, y, z = x + position[0], y + _MIRROR_Y * position[1], z + position[2]
    return np.stack([x, y, z], axis=-1)


def estimate(down: np.ndarray, gyro: np.ndarray, legs: np.ndarray, leg_rates: np.ndarray) -> Estimate:
    """Estimate the pelvis velocity and height, and how far the planted sole is tipped over.

    Args:
        down: (N, 3) direction of gravity in the pelvis frame.
        gyro: (N, 3) angular velocity in the pelvis frame [rad/s].
        legs: (N, 12) positions of ``g1.LEG_JOINTS`` [rad].
        leg_rates: (N, 12) their velocities [rad/s].
    """
    soles, later, above = sole_points(np.stack([legs, legs + EPSILON * leg_rates, legs]), _POINTS)  # (N, 2, 3) each
    normals = above - soles
    moving = (later - soles) / EPSILON + _cross(gyro[:, None], soles)
    up = -down
    forward = np.array([1.0, 0.0, 0.0]) - up[:, :1] * up
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-6)
    heading = np.stack([forward, _cross(up, forward)], axis=1)  # (N, 2, 3): rows are heading axes in the pelvis frame
    height = (soles * up[:, None]).sum(axis=2)
    left = np.clip(0.5 + (height[:, 1] - height[:, 0]) / HEIGHT_BLEND, 0.0, 1.0)
    weights = np.stack([left, 1 - left], axis=1)[..., None]  # (N, 2, 1)
    velocity = -(heading * (weights * moving).sum(axis=1)[:, None]).sum(axis=2)
    upright = (normals * up[:, None]).sum(axis=2)
    tilt = arccos(np.clip((weights[..., 0] * upright).sum(axis=1), -1.0, 1.0))
    over_soles = -(heading * soles.mean(axis=1)[:, None]).sum(axis=2)
    return Estimate(velocity, tilt, -(weights[..., 0] * height).sum(axis=1), over_soles)


def smooth(average: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Move a running average (N, 2) towards the newest estimate."""
    return average + FILTER * (np.clip(velocity, -2.0, 2.0) - average)
