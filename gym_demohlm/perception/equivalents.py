"""The pose of a symmetric object -> the one that is reported, out of all poses that look the same."""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import arctan2
from gym_demohlm.task import ObjectSpec

_HYSTERESIS = math.radians(20.0)  # by which an equivalent orientation must be nearer before it is taken


def nearest_equivalent(T_world_object: np.ndarray, entry: ObjectSpec, T_world_camera: np.ndarray) -> np.ndarray:
    """Return the pose (N, 4, 4), among those that look the same, whose x axis points most where the camera heads.

    Args:
        T_world_object: (N, 4, 4).
        entry: Says which turns about the object's z axis look the same.
        T_world_camera: (N, 4, 4), x forward.
    """
    if entry.symmetry == (0.0,):
        return T_world_object
    forward = T_world_camera[:, :2, 0]  # seen from above; its length does not matter
    along_x = (T_world_object[:, :2, 0] * forward).sum(axis=1)
    along_y = (T_world_object[:, :2, 1] * forward).sum(axis=1)
    if entry.symmetry == "any":
        turn = arctan2(along_y, along_x)
    else:
        turns = np.array(entry.symmetry)
        towards = along_x[:, None] * np.cos(turns) + along_y[:, None] * np.sin(turns)
        turn = turns[np.argmax(towards, axis=1)]
    return T_world_object @ poses.planar(0.0, 0.0, turn)


def steady_equivalent(
    T_odom_object: np.ndarray, entry: ObjectSpec, T_odom_camera: np.ndarray, last: np.ndarray | None
) -> np.ndarray:
    """Return the pose (4, 4), among those that look the same, to be told: the nearest to the camera's heading.

    The last one's equivalent stays until another is nearer by 20 degrees, so that noise at the border between two of
    them does not turn the object to and fro.

    Args:
        T_odom_object: (4, 4).
        entry: Says which turns look the same.
        T_odom_camera: (4, 4), x forward.
        last: (4, 4) what was told last; None at first.
    """
    best = nearest_equivalent(T_odom_object[None], entry, T_odom_camera[None])[0]
    if last is None or entry.symmetry == "any" or entry.symmetry == (0.0,):
        return best
    same = [T_odom_object @ poses.planar(0.0, 0.0, turn) for turn in entry.symmetry]
    kept = max(same, key=lambda T: float((T[:3, :3] * last[:3, :3]).sum()))
    return best if _off_heading(kept, T_odom_camera) > _off_heading(best, T_odom_camera) + _HYSTERESIS else kept


def _off_heading(T: np.ndarray, T_odom_camera: np.ndarray) -> float:
    """Return the angle [rad] between an object's x axis and the camera's heading, seen from above."""
    x, y = T[0, 0], T[1, 0]
    forward = T_odom_camera[:2, 0]
    return abs(math.atan2(x * forward[1] - y * forward[0], x * forward[0] + y * forward[1]))
