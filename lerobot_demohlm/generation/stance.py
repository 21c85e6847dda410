"""Where a robot came to stand and where it is -> velocities that bring it back: a base does not stay where it stopped.

A push moves the base. So does a controller whose gyroscope errs, whose motors are weak or late, or whose arms hold
more than it was told of: it steps to balance, a few centimetres each second. Hands that reach for the same place from
further and further away bend the torso, which makes it worse. A base may also drift back as fast as it
steps forward, and never arrive. So the error that remains is summed up, and the sum makes the steps faster.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.generation.locomotion import BaseEstimate

_GAIN = np.array([1.2, 1.2, 1.4])  # m/s, m/s and rad/s a metre or radian
_MOST_SUM = np.array([0.15, 0.12, 0.2])  # m/s, m/s, rad/s: the most that the sum of errors adds
_LIMIT = np.array([0.25, 0.2, 0.4])  # m/s, m/s, rad/s
_LEAST = np.array([0.10, 0.10, 0.15])  # m/s, m/s, rad/s: a slower step does not move the base
_BACK = 0.35  # share of the distance at which it sets off, within which it stands again
_RAD_PER_M = 2.0  # a turn of the base by 1 rad counts as much as a way of half a metre


class Stance:
    """Keeps one base where it stands.

    Args:
        window_ticks: Period of the gait, whose sway is no error.
        drift_gain: Velocity that each second of an error of one metre or radian adds [m/s and rad/s].

    Attributes:
        steps: Whether it is on its way back.
    """

    def __init__(self, window_ticks: int, drift_gain: float = 0.0) -> None:
        self._window, self._drift_gain = window_ticks, drift_gain
        self._stood: np.ndarray | None = None  # (4, 4) on the floor plane
        self._motion = np.eye(4)  # from the demonstrated floor plane to this one
        self._base = BaseEstimate(window_ticks)
        self._sum = np.zeros(3)  # m/s, m/s, rad/s: against a drift
        self.steps = False

    def leave(self) -> None:
        """Forget the place: the base walks."""
        self._stood, self.steps = None, False
        self._sum = np.zeros(3)
        self._base = BaseEstimate(self._window)

    def velocity(self, T_world_pelvis: np.ndarray, T_floor_base: np.ndarray, leave_m: float) -> np.ndarray:
        """Return the velocity (3,) of this tick [m/s, m/s, rad/s], in the base's frame; zero where it may stand.

        Args:
            T_world_pelvis: (4, 4) now. The first one after ``leave`` is where it is to stay.
            T_floor_base: (4, 4) the demonstrated base on its floor plane. A base that bends moves by itself: it may be
                where it stood, and where the demonstrated one would be by now.
            leave_m: Distance from there at which it steps back [m]; ``math.inf`` where it must not step now.
        """
        self._base.update(T_world_pelvis)
        here = poses.planar(*self._base.position)
        if self._stood is None:
            self._stood, self._motion = here, here @ poses.invert(T_floor_base)
        places = (self._stood, self._motion @ T_floor_base)
        errors = [poses.to_planar(poses.invert(here) @ place) for place in places]
        error = min(errors, key=_distance)
        apart = _distance(error)
        self.steps = apart > (_BACK if self.steps else 1.0) * leave_m
        if not self.steps:
            return np.zeros(3)
        self._sum = np.clip(self._sum + self._drift_gain * error * STEP_DT, -_MOST_SUM, _MOST_SUM)
        wanted = np.clip(_GAIN * error + self._sum, -_LIMIT, _LIMIT)
        scale = float(np.max(np.abs(wanted) / _LEAST))
        return wanted / min(scale, 1.0)


def _distance(error: np.ndarray) -> float:
    """Return how far a base (3,) x, y, yaw is off [m]; a turn counts as a way."""
    return max(float(norm(error[:2])), abs(float(error[2])) / _RAD_PER_M)
