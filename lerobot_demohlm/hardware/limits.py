"""What a robot may be told and what it may be seen to do: the numbers of the safety filter and of the watchdogs."""

import math
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

_NUM_LEGS, _NUM_LOWER = len(g1.LEG_JOINTS), len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS)
ARMS = slice(_NUM_LOWER, None)
"""Of the body joints."""


def _by_part(legs: float, waist: float, arms: float) -> np.ndarray:
    return np.repeat([legs, waist, arms], [_NUM_LEGS, _NUM_LOWER - _NUM_LEGS, len(g1.ARM_JOINTS)])


def _ranges() -> np.ndarray:
    return g1.joint_ranges(g1.read_mjcf())


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of commands and measurements; joints are ``g1.BODY_JOINTS``.

    Attributes:
        ranges: (29, 2) of position targets [rad].
        step: (29,) by which a target may differ from the one before, a tick of 20 ms earlier [rad]. Demonstrations
            take 0.09 in legs and 0.07 in arms. That of arms is well below ``speed``: a command far away is reached
            slowly, and is no reason to damp.
        torque: (29,) that the motors' PD may ask for at the measured state [Nm].
        speed: (29,) that joints may be seen to turn at [rad/s].
        max_kp: Largest gain [Nm/rad].
        max_kd: Largest gain [Nms/rad].
        tilt: Largest lean of the pelvis before the robot counts as falling [rad].
        overlap: By which collision shapes of arms may enter those of trunk, legs or one another [m].
        warm: Temperature of a motor at which the robot holds [Celsius].
        hot: Temperature at which it damps.
        imu_error: Angle between the attitude's gravity and that of the accelerometer, averaged over a second [rad].
        stuck_s: Time in which an encoder that should move says the same to the last bit [s].
    """

    ranges: np.ndarray = field(default_factory=_ranges)
    step: np.ndarray = field(default_factory=lambda: CONTROL_DT * _by_part(20.0, 10.0, 4.0))
    torque: np.ndarray = field(default_factory=lambda: np.array([g1.motor(j).torque_limit for j in g1.BODY_JOINTS]))
    speed: np.ndarray = field(default_factory=lambda: _by_part(20.0, 10.0, 6.0))
    max_kp: float = 300.0
    max_kd: float = 10.0
    tilt: float = math.radians(45.0)
    overlap: float = 0.01
    warm: float = 85.0
    hot: float = 95.0
    imu_error: float = 0.25
    stuck_s: float = 0.2


@dataclass(frozen=True, kw_only=True)
class Ages:
    """How old each process's newest value may be [s]. The first is answered by DAMP, the others by HOLD.

    Attributes:
        state: Of the robot.
        policy: While it runs.
        pose: While it runs.
        servos: Of neck and grippers.
        operator: Who could stop it.
        recorder: Who keeps the record.
    """

    state: float = 0.040
    policy: float = 0.300
    pose: float = 0.500
    servos: float = 0.500
    operator: float = 0.500
    recorder: float = 3.0


DAMPING = 8.0  # Nms/rad of a damped motor, as in Unitree's own debug mode
RAMP_S = 2.0  # from wherever the joints are to the home pose
COMMAND_TIMEOUT_S = 0.050
"""After which a robot without commands damps by itself, and after which a controller that slept must not go on."""
