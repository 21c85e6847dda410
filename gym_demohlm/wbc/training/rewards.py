"""The state of the training worlds -> rewards and tracking errors.

``REWARDS`` is the table of terms; weight and scale of each can be set from a configuration. Weights are a tick's, times
0.2 in the MDP. Squared errors go through exp(-e^2 / scale), a wide and a narrow one where the error starts large and
must end small.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gym_demohlm.control import attitude, features, gait_clock
from gym_demohlm.control.features import gravity
from gym_demohlm.control.settings import Gait
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.robot import g1

TOUCHING = 5.0  # N: a sole that bears this much is on the floor
_DRIVEN = len(features.DRIVEN_JOINTS)
_WAIST_YAW = features.DRIVEN_JOINTS.index("waist_yaw")
_MOTORS = [g1.motor(joint) for joint in features.DRIVEN_JOINTS]
_STIFFNESS = np.array([motor.stiffness for motor in _MOTORS])
_DAMPING = np.array([motor.damping for motor in _MOTORS])
_TORQUE_LIMIT = np.array([motor.torque_limit for motor in _MOTORS])
_WEIGHT = g1.MASS * 9.81  # N


@dataclass(frozen=True, kw_only=True)
class Air:
    """The soles in a tick, for how they land in the next.

    Attributes:
        lifted: (N, 2) bool, which are off the floor.
        speed: (N, 2) squared [m2/s2].
    """

    lifted: np.ndarray
    speed: np.ndarray

    @classmethod
    def read(cls, sensors: np.ndarray, address: Mapping[str, slice]) -> "Air":
        """Find it in sensor readings (N, .)."""
        speed = [(sensors[:, address[f"{side}_sole_vel"]] ** 2).sum(axis=1) for side in g1.SIDES]
        return cls(lifted=_touch(sensors, address) <= TOUCHING, speed=np.stack(speed, axis=1))


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What the rewards look at; velocities in the heading frame, feet as (N, 2) left and right."""

    velocity: np.ndarray  # (N, 2) [m/s]
    vertical_velocity: np.ndarray  # (N,) [m/s]
    yaw_rate: np.ndarray  # (N,) about the world's vertical [rad/s]
    gyro: np.ndarray  # (N, 3) [rad/s]
    height: np.ndarray  # (N,) pelvis [m]
    torso_roll: np.ndarray  # (N,) [rad]
    torso_pitch: np.ndarray
    waist_yaw: np.ndarray
    joint_velocity: np.ndarray  # (N, 15) driven joints [rad/s]
    torque: np.ndarray  # (N, 15) of their servos with nominal gains [Nm]
    touch: np.ndarray  # (N, 2) normal force [N]
    sole_height: np.ndarray  # (N, 2) [m]
    sole_speed: np.ndarray  # (N, 2) horizontal, squared [m2/s2]
    landing_speed: np.ndarray  # (N, 2) before touching the floor in this tick, squared; else 0 [m2/s2]
    sole_tilt: np.ndarray  # (N,) roll^2 + pitch^2 of both soles [rad2]
    sole_yaw: np.ndarray  # (N, 2) against the heading [rad]
    stance_width: np.ndarray  # (N,) left sole left of the right one [m]
    stance_length: np.ndarray  # (N,) left sole ahead of the right one [m]


def _touch(sensors: np.ndarray, address: Mapping[str, slice]) -> np.ndarray:
    return np.stack([sensors[:, address[f"{side}_sole_touch"]][:, 0] for side in g1.SIDES], axis=1)


def _yaw(quat_wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = quat_wxyz.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def measure(
    qpos: np.ndarray,
    qvel: np.ndarray,
    sensors: np.ndarray,
    address: Mapping[str, slice],
    targets: np.ndarray,
    air: Air,
) -> Measured:
    """Compute the quantities that rewards are made of.

    Args:
        qpos: (N, 7 + 23) after the tick.
        qvel: (N, 6 + 23).
        sensors: (N, .) readings.
        address: Name of a sensor -> where it is among the readings.
        targets: (N, 15 or more) of the servos [rad].
        air: The soles in the tick before.
    """
    quat = qpos[:, 3:7]
    yaw = _yaw(quat)
    cos, sin = np.cos(yaw), np.sin(yaw)
    up = -gravity(quat)
    joints, joint_velocity = qpos[:, 7 : 7 + _DRIVEN], qvel[:, 6 : 6 + _DRIVEN]
    torque = _STIFFNESS * (targets[:, :_DRIVEN] - joints) - _DAMPING * joint_velocity
    torso_roll, torso_pitch = attitude.roll_pitch(gravity(sensors[:, address["torso_quat"]]))
    soles = [sensors[:, address[f"{side}_sole_pos"]] for side in g1.SIDES]
    sole_quat = [sensors[:, address[f"{side}_sole_quat"]] for side in g1.SIDES]
    sole_attitude = [attitude.roll_pitch(gravity(quat)) for quat in sole_quat]
    sole_velocity = [sensors[:, address[f"{side}_sole_vel"]] for side in g1.SIDES]
    touch = _touch(sensors, address)
    between = soles[0] - soles[1]
    return Measured(
        velocity=np.stack(
            [cos * qvel[:, 0] + sin * qvel[:, 1], -sin * qvel[:, 0] + cos * qvel[:, 1]],
            axis=1,
        ),
        vertical_velocity=qvel[:, 2],
        yaw_rate=(up * qvel[:, 3:6]).sum(axis=1),
        gyro=qvel[:, 3:6],
        height=qpos[:, 2],
        torso_roll=torso_roll,
        torso_pitch=torso_pitch,
        waist_yaw=joints[:, _WAIST_YAW],
        joint_velocity=joint_velocity,
        torque=np.clip(torque, -_TORQUE_LIMIT, _TORQUE_LIMIT),
        touch=touch,
        sole_height=np.stack([sole[:, 2] for sole in soles], axis=1),
        sole_speed=np.stack([(velocity[:, :2] ** 2).sum(axis=1) for velocity in sole_velocity], axis=1),
        landing_speed=np.where(air.lifted & (touch > TOUCHING), air.speed, 0.0),
        sole_tilt=np.square(sole_attitude).sum(axis=(0, 1)),
        sole_yaw=_wrap(np.stack([_yaw(quat) for quat in sole_quat], axis=1) - yaw[:, None]),
        stance_width=-sin * between[:, 0] + cos * between[:, 1],
        stance_length=cos * between[:, 0] + sin * between[:, 1],
    )


def planar_error(m: Measured, command: np.ndarray) -> np.ndarray:
    """Return the errors of forward and sideways velocity [m/s] and yaw rate [rad/s], (N, 3)."""
    return np.column_stack([m.velocity, m.yaw_rate]) - command[:, :3]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a tick led to, and what was asked.

    Attributes:
        m: What was measured after it.
        command: (N, 7), slewed.
        clock: Of the gait.
        gait: How it should walk.
        action: (N, 15) of this tick.
        last_action: (N, 15) of the tick before.
        action_before: (N, 15) of the tick before that.
        mean_error: (N, 3) error of velocity and yaw rate, averaged over about a gait period: what becomes drift.
    """

    m: Measured
    command: np.ndarray
    clock: gait_clock.Clock
    gait: Gait
    action: np.ndarray
    last_action: np.ndarray
    action_before: np.ndarray
    mean_error: np.ndarray

    @property
    def stands(self) -> np.ndarray:
        """1 where the clock rests, (N,)."""
        return self.clock.standing.astype(np.float64)

    @property
    def stops(self) -> np.ndarray:
        """1 where no velocity is asked for, (N,)."""
        return np.where((np.abs(self.command[:, :3]) < gait_clock.WALK_THRESHOLD).all(axis=1), 1.0, 0.0)

    @property
    def velocity_error(self) -> np.ndarray:
        """Squared, (N,) [m2/s2]."""
        return ((self.m.velocity - self.command[:, :2]) ** 2).sum(axis=1)

    @property
    def yaw_rate_error(self) -> np.ndarray:
        """(N,) [rad/s]."""
        return self.m.yaw_rate - self.command[:, 2]

    @property
    def height_error(self) -> np.ndarray:
        """(N,) [m]."""
        return self.m.height - self.command[:, 3]

    @property
    def roll_error(self) -> np.ndarray:
        """(N,) [rad]."""
        return self.m.torso_roll - self.command[:, 4]

    @property
    def pitch_error(self) -> np.ndarray:
        """(N,) [rad]."""
        return self.m.torso_pitch - self.command[:, 5]

    @property
    def waist_error(self) -> np.ndarray:
        """(N,) [rad]."""
        return self.m.waist_yaw - self.command[:, 6]

    @property
    def drift(self) -> np.ndarray:
        """Squared mean error of the velocity, (N,) [m2/s2]."""
        return (self.mean_error[:, :2] ** 2).sum(axis=1)

    @property
    def touches(self) -> np.ndarray:
        """Which soles are on the floor, (N, 2) bool."""
        return self.m.touch > TOUCHING


@dataclass(frozen=True, kw_only=True)
class RewardTerm:
    """How much a term of the reward counts.

    Attributes:
        weight: Factor of what the term measures; negative for what should not be.
        scale: Its width: of exp(-e^2 / scale) in the unit of e^2, or a bound or limit of the measured quantity.
    """

    weight: float
    scale: float = 1.0


def _near(squared: np.ndarray, scale: float) -> np.ndarray:
    return np.exp(-squared / scale)


def _schedule(o: Outcome) -> np.ndarray:
    swings, _ = gait_clock.swing_state(o.clock.phase, o.clock.standing, o.gait)
    return (o.touches != swings).sum(axis=1) - 2.0


def _swing_height(o: Outcome) -> np.ndarray:
    _, height = gait_clock.swing_state(o.clock.phase, o.clock.standing, o.gait)
    return ((o.m.sole_height - height) ** 2).sum(axis=1)


Measure = Callable[[Outcome, float], np.ndarray]
"""An outcome and a scale -> what a weight is for, (N,)."""

_TERMS: dict[str, tuple[RewardTerm, Measure]] = {
    "velocity": (RewardTerm(weight=1.2, scale=0.25), lambda o, s: _near(o.velocity_error, s)),
    "velocity_narrow": (RewardTerm(weight=1.8, scale=0.025), lambda o, s: _near(o.velocity_error, s)),
    "velocity_far_off": (RewardTerm(weight=-0.8, scale=0.5), lambda o, s: np.minimum(np.sqrt(o.velocity_error), s)),
    "yaw_rate": (RewardTerm(weight=0.5, scale=1.0), lambda o, s: _near(o.yaw_rate_error**2, s)),
    "yaw_rate_narrow": (RewardTerm(weight=1.0, scale=0.15), lambda o, s: _near(o.yaw_rate_error**2, s)),
    "yaw_rate_narrowest": (RewardTerm(weight=1.6, scale=0.03), lambda o, s: _near(o.yaw_rate_error**2, s)),
    "yaw_rate_far_off": (RewardTerm(weight=-1.0, scale=1.0), lambda o, s: np.minimum(np.abs(o.yaw_rate_error), s)),
    # Exploration hides a small error from the narrow terms; to the mean of a square it only adds a constant.
    "velocity_squared": (RewardTerm(weight=0.0, scale=0.25), lambda o, s: np.minimum(o.velocity_error, s)),
    "yaw_rate_squared": (RewardTerm(weight=0.0, scale=1.0), lambda o, s: np.minimum(o.yaw_rate_error**2, s)),
    "drift": (RewardTerm(weight=0.8, scale=0.03), lambda o, s: _near(o.drift, s)),
    "drift_narrow": (RewardTerm(weight=0.8, scale=0.004), lambda o, s: _near(o.drift, s)),
    "turn_drift": (RewardTerm(weight=0.6, scale=0.02), lambda o, s: _near(o.mean_error[:, 2] ** 2, s)),
    "height": (RewardTerm(weight=0.8, scale=0.004), lambda o, s: _near(o.height_error**2, s)),
    "height_narrow": (RewardTerm(weight=0.6, scale=0.0002), lambda o, s: _near(o.height_error**2, s)),
    "tilt": (RewardTerm(weight=0.8, scale=0.1), lambda o, s: _near(o.pitch_error**2 + o.roll_error**2, s)),
    "pitch": (RewardTerm(weight=1.0, scale=0.02), lambda o, s: _near(o.pitch_error**2, s)),
    "pitch_narrow": (RewardTerm(weight=1.0, scale=0.0008), lambda o, s: _near(o.pitch_error**2, s)),
    "roll": (RewardTerm(weight=0.8, scale=0.01), lambda o, s: _near(o.roll_error**2, s)),
    "roll_narrow": (RewardTerm(weight=0.8, scale=0.0006), lambda o, s: _near(o.roll_error**2, s)),
    # Far off, the terms above are flat; these are not.
    "pitch_far_off": (RewardTerm(weight=-5.0), lambda o, s: np.minimum(np.abs(o.pitch_error), s)),
    "roll_far_off": (RewardTerm(weight=-6.0), lambda o, s: np.minimum(np.abs(o.roll_error), s)),
    "height_far_off": (RewardTerm(weight=-6.0), lambda o, s: np.minimum(np.abs(o.height_error), s)),
    "waist_yaw": (RewardTerm(weight=0.3, scale=0.02), lambda o, s: _near(o.waist_error**2, s)),
    "waist_yaw_standing": (RewardTerm(weight=0.4, scale=0.0005), lambda o, s: o.stands * _near(o.waist_error**2, s)),
    # Steps that nothing but a loss of balance calls for.
    "restless": (RewardTerm(weight=-1.5), lambda o, _: o.stops * (1 - o.stands)),
    "schedule": (RewardTerm(weight=0.8), lambda o, _: _schedule(o)),
    "swing_height": (RewardTerm(weight=0.6, scale=0.002), lambda o, s: _near(_swing_height(o), s)),
    "sole_tilt": (RewardTerm(weight=-0.6), lambda o, s: np.minimum(o.m.sole_tilt, s)),
    "sole_yaw": (RewardTerm(weight=-0.5, scale=0.5), lambda o, s: np.minimum((o.m.sole_yaw**2).sum(axis=1), s)),
    "sole_yaw_standing": (
        RewardTerm(weight=-5.5, scale=0.5),
        lambda o, s: o.stands * np.minimum((o.m.sole_yaw**2).sum(axis=1), s),
    ),
    "slip": (RewardTerm(weight=-0.4, scale=2.0), lambda o, s: np.minimum((o.m.sole_speed * o.touches).sum(axis=1), s)),
    "landing": (RewardTerm(weight=-0.8, scale=4.0), lambda o, s: np.minimum(o.m.landing_speed.sum(axis=1), s)),
    "impact": (
        RewardTerm(weight=-0.4, scale=1.5),  # body weights that a foot may bear
        lambda o, s: np.clip(o.m.touch / _WEIGHT - s, 0.0, 3.0).sum(axis=1),
    ),
    # Scales are widths [m].
    "close_feet": (RewardTerm(weight=-8.0, scale=0.14), lambda o, s: np.maximum(s - o.m.stance_width, 0.0)),
    "close_feet_standing": (
        RewardTerm(weight=-6.0, scale=0.23),
        lambda o, s: o.stops * np.maximum(s - o.m.stance_width, 0.0),
    ),
    "wide_feet": (RewardTerm(weight=-3.0, scale=0.34), lambda o, s: np.maximum(o.m.stance_width - s, 0.0)),
    "staggered_feet": (
        RewardTerm(weight=-4.0, scale=0.3),
        lambda o, s: o.stops * np.minimum(np.abs(o.m.stance_length), s),
    ),
    "still": (
        RewardTerm(weight=0.4, scale=0.002),
        lambda o, s: o.stands * _near((o.m.velocity**2).sum(axis=1) + 0.1 * o.m.yaw_rate**2, s),
    ),
    "action_rate": (RewardTerm(weight=-0.03), lambda o, _: ((o.action - o.last_action) ** 2).sum(axis=1)),
    "action_jerk": (
        RewardTerm(weight=-0.01),
        lambda o, _: ((o.action - 2 * o.last_action + o.action_before) ** 2).sum(axis=1),
    ),
    "action": (RewardTerm(weight=-0.006), lambda o, _: (o.action**2).sum(axis=1)),
    "joint_velocity": (
        RewardTerm(weight=-0.0004, scale=400.0),
        lambda o, s: np.minimum((o.m.joint_velocity**2).sum(axis=1), s),
    ),
    "joint_velocity_standing": (
        RewardTerm(weight=-0.002, scale=400.0),
        lambda o, s: o.stands * np.minimum((o.m.joint_velocity**2).sum(axis=1), s),
    ),
    "power": (  # [W]
        RewardTerm(weight=-0.002, scale=1000.0),
        lambda o, s: np.minimum(np.abs(o.m.torque * o.m.joint_velocity).sum(axis=1), s),
    ),
    "torque": (RewardTerm(weight=-0.2), lambda o, _: ((o.m.torque / _TORQUE_LIMIT) ** 2).sum(axis=1)),
    "tilt_rate": (RewardTerm(weight=-0.05), lambda o, _: (o.m.gyro[:, :2] ** 2).sum(axis=1)),
    "bounce": (RewardTerm(weight=-0.3), lambda o, _: o.m.vertical_velocity**2),
    "alive": (RewardTerm(weight=0.5), lambda o, _: np.ones(len(o.command))),
}

REWARDS: dict[str, RewardTerm] = {name: term for name, (term, _) in _TERMS.items()}
"""Every term with its default weight and scale."""


def with_weights(changes: Mapping[str, float]) -> dict[str, RewardTerm]:
    """Return the table with other weights of some terms.

    Raises:
        UnknownNameError: There is no such term.
    """
    for name in changes:
        if name not in REWARDS:
            raise UnknownNameError("reward", name, REWARDS)
    return {name: replace(term, weight=changes.get(name, term.weight)) for name, term in REWARDS.items()}


def parse(text: str) -> tuple[str, float]:
    """Return name and weight of ``NAME=WEIGHT``.

    Raises:
        SceneError: It is not of that form, or the weight is not finite.
        UnknownNameError: There is no such term.
    """
    name, _, weight = text.partition("=")
    if name not in REWARDS:
        raise UnknownNameError("reward", name, REWARDS)
    try:
        value = float(weight)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        expected = "NAME=WEIGHT with a finite number"
        raise SceneError(f"the reward {text!r}", expected, f"for example {name}={REWARDS[name].weight}")
    return name, value


def total(outcome: Outcome, table: Mapping[str, RewardTerm]) -> tuple[np.ndarray, dict[str, float]]:
    """Return the reward of each world (N,) and the mean of each term that has a weight."""
    terms = {
        name: term.weight * _TERMS[name][1](outcome, term.scale) for name, term in table.items() if term.weight != 0.0
    }
    return np.sum(list(terms.values()), axis=0), {name: float(term.mean()) for name, term in terms.items()}


def tracking(m: Measured, command: np.ndarray, standing: np.ndarray) -> dict[str, float]:
    """Return mean absolute tracking errors of walking and standing worlds, for the log."""
    errors = {
        "vx": m.velocity[:, 0] - command[:, 0],
        "vy": m.velocity[:, 1] - command[:, 1],
        "yaw_rate": m.yaw_rate - command[:, 2],
        "height": m.height - command[:, 3],
        "pitch": m.torso_pitch - command[:, 5],
        "roll": m.torso_roll - command[:, 4],
        "yaw": m.waist_yaw - command[:, 6],
    }
    found: dict[str, float] = {}
    for mode, mask in (("walk", ~standing), ("stand", standing)):
        if mask.any():
            found |= {f"{mode}_{name}": float(np.abs(error[mask]).mean()) for name, error in errors.items()}
    return found
