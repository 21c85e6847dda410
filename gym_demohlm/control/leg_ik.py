"""Where the ankles should be, soles level -> the joints of the legs, in closed form.

A G1 leg is hip pitch, roll, yaw, knee, ankle pitch, roll. Its thigh hangs straight under the hip pitch axis, but its
hip roll and yaw axes are inclined by ``INCLINATION``: R_pelvis_thigh = Ry(pitch - i) Rx(roll) Rz(yaw) Ry(i).
The roll and yaw axes meet in a point ahead of and below the pitch axis, so a leg is solved twice: from the pitch axis,
which tells where that point goes, and from that point.
"""

import math
from typing import NamedTuple

import numpy as np

from gym_demohlm.arithmetic import arccos, arctan2, hypot
from gym_demohlm.robot import g1

INCLINATION = 2 * math.asin(0.08733857)  # rad
AHEAD, BELOW = 0.0246, 0.0262  # m: where the roll and yaw axes meet, seen from the pitch axis
THIGH_FROM_THERE = math.hypot(AHEAD, g1.THIGH_LENGTH - BELOW)
THIGH_ANGLE = math.atan2(AHEAD, g1.THIGH_LENGTH - BELOW)
_SIDES = np.array([1.0, -1.0])  # left, right
_AXES = np.eye(3)[:, :, None, None]  # components of the unit vectors


class Vectors(NamedTuple):
    """Components of vectors, arrays of one shape each."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray


def _about_x(v: Vectors, angle: np.ndarray) -> Vectors:
    c, s = np.cos(angle), np.sin(angle)
    return Vectors(v.x, c * v.y - s * v.z, s * v.y + c * v.z)


def _about_y(v: Vectors, angle: np.ndarray) -> Vectors:
    c, s = np.cos(angle), np.sin(angle)
    return Vectors(c * v.x + s * v.z, v.y, c * v.z - s * v.x)


def _about_z(v: Vectors, angle: np.ndarray) -> Vectors:
    c, s = np.cos(angle), np.sin(angle)
    return Vectors(c * v.x - s * v.y, s * v.x + c * v.y, v.z)


def planar(
    forward: np.ndarray, down: np.ndarray, upper: float = g1.THIGH_LENGTH
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve a leg in its own plane.

    Args:
        forward: Ankle ahead of the hip [m].
        down: Ankle below the hip [m]; a leg too short for it stretches out.
        upper: Hip to knee [m].

    Returns:
        Angle of the thigh against the vertical, negative forwards; knee; ankle pitch with the sole level [rad].
    """
    lower = g1.SHANK_LENGTH
    distance = np.clip(np.sqrt(forward * forward + down * down), 0.22, upper + lower - 0.004)
    knee = np.pi - arccos(np.clip((upper**2 + lower**2 - distance**2) / (2 * upper * lower), -1, 1))
    lean = arccos(np.clip((upper**2 + distance**2 - lower**2) / (2 * upper * distance), -1, 1))
    thigh = -arctan2(forward, down) - lean
    return thigh, knee, -(thigh + knee)


def solve(ankles: Vectors, sole_yaw: np.ndarray, tilt: np.ndarray, bank: np.ndarray) -> np.ndarray:
    """Solve both legs.

    Args:
        ankles: (N, 2) components each, ankles from the pelvis origin in the heading frame of the pelvis, left and
            right [m].
        sole_yaw: (N, 2) yaw of the level soles in the heading frame [rad].
        tilt: (N, 1) pitch of the pelvis, R_heading_pelvis = Ry(tilt) Rx(bank) [rad]; (N, 2) for one of each leg.
        bank: (N, 1) or (N, 2) roll of the pelvis.

    Returns:
        (N, 2, 6) joints [rad].
    """
    zero = np.zeros_like(sole_yaw)

    def in_heading(v: Vectors) -> Vectors:
        """Turn a vector by R_heading_pelvis."""
        return _about_y(_about_x(v, bank), tilt)

    hips = in_heading(Vectors(zero, zero + g1.HIP_SPREAD * _SIDES, zero - g1.HIP_DROP))
    pitch = planar(ankles.x - hips.x, hypot(ankles.y - hips.y, ankles.z - hips.z))[0] - tilt
    further = in_heading(_about_y(Vectors(zero + AHEAD, zero, zero - BELOW), pitch))
    hips = Vectors(hips.x + further.x, hips.y + further.y, hips.z + further.z)
    seen = _about_z(Vectors(hips.x - ankles.x, hips.y - ankles.y, hips.z - ankles.z), -sole_yaw)  # hip from the ankle
    ankle_roll = arctan2(seen.y, seen.z)
    thigh, knee, ankle_pitch = planar(-seen.x, hypot(seen.y, seen.z), THIGH_FROM_THERE)
    thigh, knee = thigh - THIGH_ANGLE, knee + THIGH_ANGLE

    def in_pelvis(v: Vectors) -> Vectors:
        """Turn a vector by R_pelvis_thigh Ry(-i)."""
        v = _about_z(_about_x(_about_y(v, thigh - INCLINATION), -ankle_roll), sole_yaw)
        return _about_x(_about_y(v, -tilt), -bank)

    axes = in_pelvis(Vectors(*_AXES))  # (3, N, 2) components: of the first, the second, the third axis
    hip_pitch = arctan2(axes.x[2], axes.z[2]) + INCLINATION
    hip_roll = arctan2(-axes.y[2], hypot(axes.x[2], axes.z[2]))
    hip_yaw = arctan2(axes.y[0], axes.y[1])
    return np.stack([hip_pitch, hip_roll, hip_yaw, knee, ankle_pitch, ankle_roll], axis=2)
