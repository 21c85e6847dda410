"""Pelvis and waist as measured at 10 Hz -> where they will be when the next command is carried out.

Inverse kinematics on the torso as it is now lags a walking robot by 0.1 s, a sixth of its gait, and what it corrects
comes at the wrong time. But a walk repeats itself: a parabola and the gait's first two harmonics, fitted to the last
two seconds by least squares, tell the sway a step ahead. The samples come at fixed times, so the fit is one fixed row
of numbers. On a robot at rest it is the identity.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, least_squares
from gym_demohlm.control import gait_clock
from gym_demohlm.robot import g1
from gym_demohlm.timing import STEP_DT

_WAIST = np.array([g1.BODY_JOINTS.index(joint) for joint in g1.WAIST_JOINTS])
_SAMPLES = 20
_DEGREE = 2
_HARMONICS = 2
_RIDGE = 1e-3  # on the harmonics; the polynomial is exact
_GAINS = (1.05, 1.25)  # by which a harmonic is exaggerated: linear interpolation and servos take this much off it
_CARRY = 0.5  # share of the newest sample's own deviation from the fit that is expected to last


@dataclass(frozen=True, kw_only=True)
class Outlook:
    """What is expected; arguments of ``WholeBodyIK.solve``.

    Attributes:
        T_world_pelvis: (4, 4).
        joint_positions: (29,) as measured, the waist's as expected [rad].
        T_world_heading: (4, 4) on the floor, along the pelvis's way and heading without the gait's sway.
    """

    T_world_pelvis: np.ndarray
    joint_positions: np.ndarray
    T_world_heading: np.ndarray


class Foresight:
    """The last two seconds of one robot.

    Args:
        dt: Time between measurements [s].
        horizon: How far ahead to look [s]: the arms' last targets of a step come a tick before its end, and the servos
            lag by 10 to 18 ms.
    """

    def __init__(self, dt: float = STEP_DT, horizon: float = STEP_DT) -> None:
        times = dt * np.arange(1 - _SAMPLES, 1)
        design = _basis(times)
        damping = np.diag([0.0] * (_DEGREE + 1) + [_RIDGE] * (2 * _HARMONICS))
        padded = np.concatenate([design, np.sqrt(damping)])
        samples = np.eye(len(padded), _SAMPLES)
        fit = least_squares(padded, samples)  # coefficients from samples
        newest = np.eye(_SAMPLES)[-1]
        gains = np.array([1.0] * (_DEGREE + 1) + list(_GAINS) * 2)
        ahead, now = gains * _basis(np.array([horizon]))[0], _basis(np.zeros(1))[0]
        self._expected = dot(fit.T, ahead) + _CARRY * (newest - dot(fit.T, now))  # (samples,)
        trend = np.where(np.arange(len(ahead)) <= _DEGREE, ahead, 0.0)
        self._trend = dot(fit.T, trend)
        self._seen: np.ndarray | None = None  # (samples, 9): position, roll, pitch, yaw, waist

    def reset(self) -> None:
        """Forget the past."""
        self._seen = None

    def see(self, T_world_pelvis: np.ndarray, joint_positions: np.ndarray) -> Outlook:
        """Take in a measurement and return what it leads to; at first, the robot is thought to have been at rest.

        Args:
            T_world_pelvis: (4, 4).
            joint_positions: (29,) [rad].
        """
        angles = poses.rpy(T_world_pelvis[:3, :3])
        if self._seen is not None:
            angles[2] = self._seen[-1, 5] + poses.wrap_angle(angles[2] - self._seen[-1, 5])
        newest = np.concatenate([T_world_pelvis[:3, 3], angles, joint_positions[_WAIST]])
        if self._seen is None:
            self._seen = np.tile(newest, (_SAMPLES, 1))
        self._seen = np.concatenate([self._seen[1:], newest[None]])
        change = self._seen - newest
        expected, trend = newest + dot(change.T, self._expected), newest + dot(change.T, self._trend)
        joints = joint_positions.copy()
        joints[_WAIST] = expected[6:]
        return Outlook(
            T_world_pelvis=poses.from_rotation(poses.rotation_from_rpy(expected[3:6]), expected[:3]),
            joint_positions=joints,
            T_world_heading=poses.planar(trend[0], trend[1], trend[5]),
        )


def _basis(times: np.ndarray) -> np.ndarray:
    """Return what is fitted, at times (n,) [s]: powers, then cosines and sines, (n, terms)."""
    angles = 2 * np.pi * np.outer(times, np.arange(1, _HARMONICS + 1)) / gait_clock.GAIT.period_s
    return np.concatenate([times[:, None] ** np.arange(_DEGREE + 1), np.cos(angles), np.sin(angles)], axis=1)
