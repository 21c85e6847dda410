"""Poses of a device that trembles -> poses that do not: still hands are smoothed, hands that move are followed.

The One Euro filter (Casiez, Roussel and Vogel, CHI 2012): a low-pass filter whose cutoff grows with the speed, which is
itself smoothed, so that a tremor does not count as motion. A hand at rest loses its tremor and is 0.2 s late; one that
moves by 0.2 m/s is 0.03 s late.
"""

import math
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses

LONGEST_S = 0.1  # between two poses that count as one motion
SHORTEST_S = 1e-6  # between two poses; a shorter time tells no speed


@dataclass(frozen=True, kw_only=True)
class SmoothingSettings:
    """How a device's poses are smoothed.

    Attributes:
        rest_hz: Cutoff at rest [Hz].
        hz_per_speed: What a speed adds to it [Hz per m/s].
        hz_per_turn: What turning adds to it [Hz per rad/s].
        speed_hz: Cutoff with which the speed is smoothed [Hz].
        jump_m: Distance between two poses that is no motion: it begins anew [m].
    """

    rest_hz: float = 0.8
    hz_per_speed: float = 20.0
    hz_per_turn: float = 4.0
    speed_hz: float = 1.0
    jump_m: float = 0.1


class PoseSmoother:
    """Smooths the poses of one device.

    Args:
        settings: How; None passes them on as they are.
    """

    def __init__(self, settings: SmoothingSettings | None) -> None:
        self._settings = settings
        self._raw = np.eye(4)
        self._smooth: np.ndarray | None = None  # (4, 4)
        self._velocity, self._turning = np.zeros(3), np.zeros(3)  # m/s, rad/s
        self._time = 0.0

    def reset(self) -> None:
        """Forget the past."""
        self._smooth = None

    def __call__(self, pose: np.ndarray, time_s: float) -> np.ndarray:
        """Return the smoothed pose (4, 4).

        Args:
            pose: (4, 4) of the device.
            time_s: When it was there [s].
        """
        settings = self._settings
        if settings is None:
            return pose
        passed, self._time = time_s - self._time, time_s
        moved = pose[:3, 3] - self._raw[:3, 3]
        turned = poses.rotation_vector(pose[:3, :3] @ self._raw[:3, :3].T)
        self._raw = pose.copy()
        if self._smooth is None or passed > LONGEST_S or np.linalg.norm(moved) > settings.jump_m:
            self._smooth = pose.copy()
            self._velocity, self._turning = np.zeros(3), np.zeros(3)
            return pose
        if passed < SHORTEST_S:
            return self._smooth.copy()
        share = _share(settings.speed_hz, passed)
        self._velocity = self._velocity + share * (moved / passed - self._velocity)
        self._turning = self._turning + share * (turned / passed - self._turning)
        smooth = self._smooth.copy()
        cutoff = settings.rest_hz + settings.hz_per_speed * float(np.linalg.norm(self._velocity))
        smooth[:3, 3] += _share(cutoff, passed) * (pose[:3, 3] - smooth[:3, 3])
        cutoff = settings.rest_hz + settings.hz_per_turn * float(np.linalg.norm(self._turning))
        behind = poses.rotation_vector(pose[:3, :3] @ smooth[:3, :3].T)
        smooth[:3, :3] = poses.rotation_from_vector(_share(cutoff, passed) * behind) @ smooth[:3, :3]
        self._smooth = smooth
        return smooth.copy()


def _share(cutoff_hz: float, passed_s: float) -> float:
    """Return the share of what is new that a low-pass filter takes in."""
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff_hz * passed_s))
