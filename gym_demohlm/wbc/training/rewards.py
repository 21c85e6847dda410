"""The state of the training worlds -> rewards and tracking errors.

Every reward term is one line of ``total``; weights are a tick's, times 0.2 in the MDP. Squared errors go through
exp(-e^2 / s), a wide and a narrow one where the error starts large and must end small.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm.control import attitude, reference
from gym_demohlm.control.features import gravity


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
    touch: np.ndarray  # (N, 2) normal force [N]
    sole_height: np.ndarray  # (N, 2) [m]
    sole_speed: np.ndarray  # (N, 2) horizontal, squared [m2/s2]
    sole_tilt: np.ndarray  # (N,) roll^2 + pitch^2 of both soles [rad2]
    sole_yaw: np.ndarray  # (N, 2) against the heading [rad]
    stance_width: np.ndarray  # (N,) left sole left of the right one [m]
    stance_length: np.ndarray  # (N,) left sole ahead of the right one [m]


def _yaw(quat_wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = quat_wxyz.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def measure(qpos: np.ndarray, qvel: np.ndarray, sensors: np.ndarray, address: dict[str, slice]) -> Measured:
    """Compute the quantities that rewards are made of from states (N, .) and sensor readings (N, .)."""
    quat = qpos[:, 3:7]
    yaw = _yaw(quat)
    cos, sin = np.cos(yaw), np.sin(yaw)
    up = -gravity(quat)
    torso_roll, torso_pitch = attitude.roll_pitch(gravity(sensors[:, address["torso_quat"]]))
    soles = [sensors[:, address[f"{side}_sole_pos"]] for side in ("left", "right")]
    sole_attitude = [
        attitude.roll_pitch(gravity(sensors[:, address[f"{side}_sole_quat"]])) for side in ("left", "right")
    ]
    sole_velocity = [sensors[:, address[f"{side}_sole_vel"]] for side in ("left", "right")]
    sole_quat = [sensors[:, address[f"{side}_sole_quat"]] for side in ("left", "right")]
    touch = [sensors[:, address[f"{side}_sole_touch"]][:, 0] for side in ("left", "right")]
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
        waist_yaw=qpos[:, 7 + 12],
        joint_velocity=qvel[:, 6:21],
        touch=np.stack(touch, axis=1),
        sole_height=np.stack([sole[:, 2] for sole in soles], axis=1),
        sole_speed=np.stack([(velocity[:, :2] ** 2).sum(axis=1) for velocity in sole_velocity], axis=1),
        sole_tilt=np.square(sole_attitude).sum(axis=(0, 1)),
        sole_yaw=_wrap(np.stack([_yaw(quat) for quat in sole_quat], axis=1) - yaw[:, None]),
        stance_width=-sin * between[:, 0] + cos * between[:, 1],
        stance_length=cos * between[:, 0] + sin * between[:, 1],
    )


def planar_error(m: Measured, command: np.ndarray) -> np.ndarray:
    """Return the errors of forward and sideways velocity [m/s] and yaw rate [rad/s], (N, 3)."""
    return np.column_stack([m.velocity, m.yaw_rate]) - command[:, :3]


def total(
    m: Measured,
    command: np.ndarray,
    phase: np.ndarray,
    standing: np.ndarray,
    action: np.ndarray,
    last_action: np.ndarray,
    action_before: np.ndarray,
    mean_error: np.ndarray,
) -> tuple[np.ndarray, dict[str, float]]:
    """Return the reward of each world (N,) and the mean of each term.

    Args:
        m: What was measured after the step.
        command: (N, 7), slewed.
        phase: (N,) gait clock.
        standing: (N,) bool.
        action: (N, 15) of this tick.
        last_action: (N, 15) of the tick before.
        action_before: (N, 15) of the tick before that.
        mean_error: (N, 3) error of velocity and yaw rate, averaged over about a gait period: what becomes drift.
    """
    stand = standing.astype(np.float64)
    drift = (mean_error[:, :2] ** 2).sum(axis=1)
    stop = (np.abs(command[:, :3]) < reference.WALK_THRESHOLD).all(axis=1).astype(np.float64)
    swing, swing_height = reference.swing_state(phase, standing)
    contact = m.touch > 5.0
    velocity_error = ((m.velocity - command[:, :2]) ** 2).sum(axis=1)
    yaw_error = (m.yaw_rate - command[:, 2]) ** 2
    height_error = (m.height - command[:, 3]) ** 2
    pitch_error, roll_error = (m.torso_pitch - command[:, 5]) ** 2, (m.torso_roll - command[:, 4]) ** 2
    waist_error = (m.waist_yaw - command[:, 6]) ** 2
    still = (m.velocity**2).sum(axis=1) + 0.1 * m.yaw_rate**2
    terms = {
        "velocity": 1.2 * np.exp(-velocity_error / 0.25) + 1.8 * np.exp(-velocity_error / 0.025),
        "yaw_rate": 0.5 * np.exp(-yaw_error / 1.0)
        + 1.0 * np.exp(-yaw_error / 0.15)
        + 1.6 * np.exp(-yaw_error / 0.03)
        - 1.0 * np.minimum(np.sqrt(yaw_error), 1.0),
        "drift": 0.8 * np.exp(-drift / 0.03) + 0.8 * np.exp(-drift / 0.004),
        "turn_drift": 0.6 * np.exp(-(mean_error[:, 2] ** 2) / 0.02),
        "height": 0.8 * np.exp(-height_error / 0.004) + 0.5 * np.exp(-height_error / 0.0004),
        "tilt": 0.8 * np.exp(-(pitch_error + roll_error) / 0.1),
        "pitch": 1.0 * np.exp(-pitch_error / 0.02) + 0.6 * np.exp(-pitch_error / 0.002),
        "roll": 0.8 * np.exp(-roll_error / 0.01) + 0.8 * np.exp(-roll_error / 0.0006),
        # Far off, the terms above are flat; this one is not.
        "far_off": -5.0 * np.minimum(np.abs(m.torso_pitch - command[:, 5]), 1.0)
        - 6.0 * np.minimum(np.abs(m.torso_roll - command[:, 4]), 1.0)
        - 6.0 * np.abs(m.height - command[:, 3]),
        "waist_yaw": 0.3 * np.exp(-waist_error / 0.02) + 0.4 * stand * np.exp(-waist_error / 0.0005),
        # Steps that nothing but a loss of balance calls for.
        "restless": -1.5 * stop * (1 - stand),
        "schedule": 0.8 * ((contact != swing).sum(axis=1) - 2.0),
        "swing_height": 0.6 * np.exp(-((m.sole_height - swing_height) ** 2).sum(axis=1) / 0.002),
        "sole_tilt": -0.6 * np.minimum(m.sole_tilt, 1.0),
        "sole_yaw": -(0.5 + 5.5 * stand) * np.minimum((m.sole_yaw**2).sum(axis=1), 0.5),
        "slip": -0.4 * np.minimum((m.sole_speed * contact).sum(axis=1), 2.0),
        "stance": -8.0 * np.maximum(0.20 - m.stance_width, 0)
        - 6.0 * stop * np.maximum(0.23 - m.stance_width, 0)
        - 3.0 * np.maximum(m.stance_width - 0.34, 0)
        - 4.0 * stop * np.minimum(np.abs(m.stance_length), 0.3),
        "still": 0.4 * stand * np.exp(-still / 0.002),
        "action_rate": -0.03 * ((action - last_action) ** 2).sum(axis=1),
        "action_jerk": -0.01 * ((action - 2 * last_action + action_before) ** 2).sum(axis=1),
        "action": -0.006 * (action**2).sum(axis=1),
        "joint_velocity": -(0.0004 + 0.002 * stand) * np.minimum((m.joint_velocity**2).sum(axis=1), 400.0),
        "tilt_rate": -0.05 * (m.gyro[:, :2] ** 2).sum(axis=1),
        "bounce": -0.3 * m.vertical_velocity**2,
        "alive": np.full(len(command), 0.5),
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
