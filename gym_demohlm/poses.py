"""Positions, quaternions and angles -> rigid poses as 4x4 matrices, and back: compose, invert, interpolate; batched.

A pose ``T_a_b`` of frame b in frame a is a float64 array (..., 4, 4); leading dimensions broadcast. Poses compose with
``@``: ``T_a_c = T_a_b @ T_b_c``. Every function returns new arrays. Quaternions are ``wxyz``, scalar first.
"""

import numpy as np
from numpy.typing import ArrayLike

from gym_demohlm.arithmetic import arctan2, hypot, transposed_product

_TINY = 1e-12  # below this angle [rad] or length, a limit replaces a quotient


def pose(position: ArrayLike, quat_wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the pose (..., 4, 4) of a position (..., 3) [m] and a quaternion (..., 4), normalised here."""
    return from_rotation(quat_to_matrix(quat_wxyz), position)


def from_rotation(rotation: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the pose (..., 4, 4) of a rotation matrix (..., 3, 3) and a position (..., 3) [m]."""
    rotation = np.asarray(rotation, dtype=np.float64)
    position = np.asarray(position, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1]), 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def split(T: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return position (..., 3) [m] and quaternion (..., 4) of a pose; the quaternion's scalar is not negative."""
    T = np.asarray(T, dtype=np.float64)
    return T[..., :3, 3].copy(), matrix_to_quat(T[..., :3, :3])


def invert(T: ArrayLike) -> np.ndarray:
    """Return the inverse pose, ``T_b_a`` of ``T_a_b``."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    return from_rotation(np.swapaxes(R, -1, -2), -transposed_product(R, T[..., :3, 3]))


def transform(T: ArrayLike, points: ArrayLike) -> np.ndarray:
    """Bring points (..., 3) [m] of frame b into frame a with ``T_a_b``."""
    T = np.asarray(T, dtype=np.float64)
    points = np.asarray(points, dtype=np.float64)
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def interpolate(T0: ArrayLike, T1: ArrayLike, u: ArrayLike) -> np.ndarray:
    """Return the pose a share u in [0, 1] of the way from T0 to T1: position linear, rotation slerp (the short way).

    Args:
        T0: (..., 4, 4), exactly returned at u = 0.
        T1: (..., 4, 4), exactly returned at u = 1.
        u: (...), broadcast against the leading dimensions.
    """
    T0, T1 = np.asarray(T0, dtype=np.float64), np.asarray(T1, dtype=np.float64)
    u = np.asarray(u, dtype=np.float64)
    R0, R1 = T0[..., :3, :3], T1[..., :3, :3]
    turn = rotation_vector(np.swapaxes(R0, -1, -2) @ R1)
    rotation = R0 @ rotation_from_vector(u[..., None] * turn)
    position = (1.0 - u[..., None]) * T0[..., :3, 3] + u[..., None] * T1[..., :3, 3]
    T = from_rotation(rotation, position)
    weight = u[..., None, None]
    return np.where(weight == 0.0, T0, np.where(weight == 1.0, T1, T))


def planar(x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> np.ndarray:
    """Return the pose of a planar motion: x, y [m] and a turn about the vertical [rad]."""
    angle = np.asarray(yaw, dtype=np.float64)
    cosine, sine = np.cos(angle), np.sin(angle)
    T = np.zeros((*np.broadcast_shapes(np.shape(x), np.shape(y), angle.shape), 4, 4))
    T[..., 0, 0], T[..., 0, 1] = cosine, -sine
    T[..., 1, 0], T[..., 1, 1] = sine, cosine
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    T[..., 0, 3], T[..., 1, 3] = x, y
    return T


def yaw(T: ArrayLike) -> np.ndarray:
    """Return the heading (...) [rad] in (-pi, pi]: the angle of the frame's x axis seen from above."""
    T = np.asarray(T, dtype=np.float64)
    return arctan2(T[..., 1, 0], T[..., 0, 0])


def heading(T: ArrayLike) -> np.ndarray:
    """Return the pose with roll and pitch removed: same position, only the yaw kept."""
    T = np.asarray(T, dtype=np.float64)
    upright = planar(T[..., 0, 3], T[..., 1, 3], yaw(T))
    upright[..., 2, 3] = T[..., 2, 3]
    return upright


def to_planar(T: ArrayLike) -> np.ndarray:
    """Return (x, y, yaw) (..., 3) [m, m, rad] of a pose; ``planar`` of it drops height and tilt."""
    T = np.asarray(T, dtype=np.float64)
    return np.stack([T[..., 0, 3], T[..., 1, 3], yaw(T)], axis=-1)


def wrap_angle(angle: ArrayLike) -> np.ndarray:
    """Return the angle [rad] brought into [-pi, pi)."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def rpy(R: ArrayLike) -> np.ndarray:
    """Return roll, pitch, yaw (..., 3) [rad] with ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
    R = np.asarray(R, dtype=np.float64)
    roll = arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = arctan2(-R[..., 2, 0], hypot(R[..., 2, 1], R[..., 2, 2]))
    return np.stack([roll, pitch, arctan2(R[..., 1, 0], R[..., 0, 0])], axis=-1)


def rotation_from_rpy(angles: ArrayLike) -> np.ndarray:
    """Return ``Rz(yaw) @ Ry(pitch) @ Rx(roll)`` (..., 3, 3) of roll, pitch, yaw (..., 3) [rad]."""
    by_axis = np.moveaxis(np.asarray(angles, dtype=np.float64), -1, 0)
    cr, cp, cy = np.cos(by_axis)
    sr, sp, sy = np.sin(by_axis)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_vector(R: ArrayLike) -> np.ndarray:
    """Return axis times angle (..., 3) [rad] of a rotation matrix, the angle in [0, pi]."""
    quat_wxyz = matrix_to_quat(R)
    vector = quat_wxyz[..., 1:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * arctan2(sine, quat_wxyz[..., :1])
    return vector * np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0)


def rotation_from_vector(vector: ArrayLike) -> np.ndarray:
    """Return the rotation matrix (..., 3, 3) of axis times angle (..., 3) [rad]."""
    vector = np.asarray(vector, dtype=np.float64)
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    scale = np.where(half > _TINY, 0.5 * np.sin(half) / np.maximum(half, _TINY), 0.5)
    return quat_to_matrix(np.concatenate([np.cos(half), scale * vector], axis=-1))


def quat_to_matrix(quat_wxyz: ArrayLike) -> np.ndarray:
    """Return the rotation matrix (..., 3, 3) of a quaternion (..., 4) of any length but zero."""
    quat = np.asarray(quat_wxyz, dtype=np.float64)
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    R = np.empty((*quat.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


def matrix_to_quat(R: ArrayLike) -> np.ndarray:
    """Return the quaternion (..., 4) of a rotation matrix (..., 3, 3); its scalar is not negative.

    Shepperd's method uses the one of four equivalent formulas that has the largest divisor.
    """
    R = np.asarray(R, dtype=np.float64)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    candidates = np.empty((*R.shape[:-2], 4, 4))  # row i is 4 q_i times the quaternion; symmetric
    candidates[..., 0, 0], candidates[..., 1, 1] = 1 + xx + yy + zz, 1 + xx - yy - zz
    candidates[..., 2, 2], candidates[..., 3, 3] = 1 - xx + yy - zz, 1 - xx - yy + zz
    candidates[..., 0, 1] = candidates[..., 1, 0] = R[..., 2, 1] - R[..., 1, 2]
    candidates[..., 0, 2] = candidates[..., 2, 0] = R[..., 0, 2] - R[..., 2, 0]
    candidates[..., 0, 3] = candidates[..., 3, 0] = R[..., 1, 0] - R[..., 0, 1]
    candidates[..., 1, 2] = candidates[..., 2, 1] = R[..., 0, 1] + R[..., 1, 0]
    candidates[..., 1, 3] = candidates[..., 3, 1] = R[..., 0, 2] + R[..., 2, 0]
    candidates[..., 2, 3] = candidates[..., 3, 2] = R[..., 1, 2] + R[..., 2, 1]
    rows = candidates.reshape(-1, 4, 4)
    best = rows.diagonal(axis1=1, axis2=2).argmax(axis=-1)
    quat_wxyz = rows[np.arange(len(rows)), best].reshape(candidates.shape[:-1])
    quat_wxyz = quat_wxyz / np.linalg.norm(quat_wxyz, axis=-1, keepdims=True)
    return np.where(quat_wxyz[..., :1] < 0.0, -quat_wxyz, quat_wxyz)
