"""Roll, pitch and yaw of the torso -> how it leans, and how pelvis and waist share that; and back from gravity.

Torso roll and pitch are against gravity, torso yaw is the waist's: in the order yaw, pitch, roll. The heading frame is
the pelvis's, turned upright.
"""

import numpy as np

from gym_demohlm.arithmetic import arcsin, arctan2, hypot

_WAIST_LEAN = (-0.35, 0.4)  # rad: what of a forward lean the waist takes
WAIST_ROLL = 0.4  # rad: what of a sideways lean the waist takes before the pelvis rolls
WAIST_BEND = 0.48  # rad
LARGEST_BANK = 0.45  # rad: one hip closes by this much
WAIST_LIMIT = 0.5  # rad: roll and pitch of the waist


def lean(roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a torso leans forward and to its right in the heading frame of the pelvis [rad].

    Args:
        roll: (N,) torso roll against gravity.
        pitch: (N,) torso pitch against gravity.
        yaw: (N,) torso yaw against the pelvis.
    """
    ahead, left, up = np.cos(roll) * np.sin(pitch), -np.sin(roll), np.cos(roll) * np.cos(pitch)
    x, y = np.cos(yaw) * ahead - np.sin(yaw) * left, np.sin(yaw) * ahead + np.cos(yaw) * left
    return arctan2(x, up), arctan2(-y, hypot(x, up))


def pelvis_attitude(ahead: np.ndarray, aside: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share a lean between the pelvis and the waist, which bends by ``WAIST_BEND`` at most in any direction.

    Args:
        ahead: (N,) forward lean of the torso [rad].
        aside: (N,) its lean to the right.
        tilt: (N,) the pitch that the pelvis should have.

    Returns:
        Pitch and roll of the pelvis (N,), (N,) [rad].
    """
    waist_ahead, waist_aside = ahead - tilt, np.clip(aside, -WAIST_ROLL, WAIST_ROLL)
    share = np.minimum(WAIST_BEND / np.maximum(hypot(waist_ahead, waist_aside), WAIST_BEND), 1.0)
    bank = np.clip(aside - share * waist_aside, -LARGEST_BANK, LARGEST_BANK)
    return ahead - share * waist_ahead, bank


def comfortable_pitch(lean: float) -> float:
    """Return the pelvis pitch [rad] of a forward lean: the waist takes 0.6 of it within its comfortable range."""
    return lean - min(max(0.6 * lean, _WAIST_LEAN[0]), _WAIST_LEAN[1])


def waist_angles(
    roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray, tilt: np.ndarray, bank: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the waist for a torso attitude on a tilted pelvis.

    With R_pelvis = Ry(tilt) Rx(bank), R_torso = R_pelvis Rz(yaw) Rx(waist roll) Ry(waist pitch) must see gravity where
    a torso of this roll and pitch sees it.

    Args:
        roll: (N,) torso roll against gravity [rad].
        pitch: (N,) torso pitch against gravity.
        yaw: (N,) waist yaw.
        tilt: (N,) pelvis pitch.
        bank: (N,) pelvis roll.

    Returns:
        Waist roll and pitch (N,), (N,) within the waist's range.
    """
    x0, y0, z0 = -np.sin(tilt), np.sin(bank) * np.cos(tilt), np.cos(bank) * np.cos(tilt)  # up in the pelvis frame
    x1, y1 = np.cos(yaw) * x0 + np.sin(yaw) * y0, np.cos(yaw) * y0 - np.sin(yaw) * x0
    ux, uy, uz = -np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)  # up in the torso frame
    length = np.maximum(hypot(y1, z0), 1e-6)
    waist_roll = arcsin(np.clip(uy / length, -1, 1)) - arctan2(y1, z0)
    waist_roll = np.clip(waist_roll, -WAIST_LIMIT, WAIST_LIMIT)
    z1 = np.cos(waist_roll) * z0 - np.sin(waist_roll) * y1
    waist_pitch = arctan2(x1 * uz - z1 * ux, x1 * ux + z1 * uz)
    return waist_roll, np.clip(waist_pitch, -WAIST_LIMIT, WAIST_LIMIT)


def in_torso(v: np.ndarray, waist: np.ndarray) -> np.ndarray:
    """Turn vectors (N, 3) from the pelvis frame into that of the torso; waist (N, 3) is yaw, roll, pitch [rad]."""
    (x, y, z), (yaw, roll, pitch) = v.T, np.ascontiguousarray(waist.T)
    x, y = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
    y, z = np.cos(roll) * y + np.sin(roll) * z, np.cos(roll) * z - np.sin(roll) * y
    return np.stack([np.cos(pitch) * x - np.sin(pitch) * z, y, np.cos(pitch) * z + np.sin(pitch) * x], axis=1)


def roll_pitch(down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return roll and pitch (N,) [rad] of the frame in which gravity points along ``down`` (N, 3)."""
    x, y, z = np.ascontiguousarray(-down.T)
    return arctan2(y, z), arctan2(-x, hypot(y, z))
