"""A command and a gait clock -> the closed-form reference joint targets that the whole-body policy corrects.

Standing: a planar two-link leg puts the soles under a pelvis at the commanded height, shifted fore and aft by a
quasi-static table so that the centre of mass stays over the feet (the idea of AMO's adapter). Walking: a clocked
trot in place with foot placement from the velocity command. Open loop it falls within seconds; it is a starting point.
"""

from dataclasses import dataclass

import numpy as np

from gym_demohlm.robot import g1

CONTROL_DT = 0.02  # s: 50 Hz
NUM_LOWER = len(g1.LEG_JOINTS) + len(g1.WAIST_JOINTS)  # the joints that the policy drives


@dataclass(frozen=True, kw_only=True)
class Gait:
    """The walking reference.

    Attributes:
        period_s: Time of two steps [s].
        swing: Part of the period in which a foot is in the air; the right foot swings half a period after the left.
        lift: Height of the sole at mid-swing [m].
        sway: Amplitude of the lateral sway of the pelvis [m].
    """

    period_s: float = 0.72
    swing: float = 0.4
    lift: float = 0.07
    sway: float = 0.03


GAIT = Gait()
# The clock rests just before a swing, where both feet are on the floor.
REST_PHASES = (0.5 * (0.5 + GAIT.swing), 0.5 + 0.5 * (0.5 + GAIT.swing))
WALK_THRESHOLD = np.array([0.04, 0.04, 0.08])  # m/s, m/s, rad/s: slower commands mean "stand"
SLEW = np.array([1.5, 1.5, 3.0, 0.4, 1.2, 1.2, 1.5])  # fastest change of the command's first seven numbers, per second
WALK_HEIGHT, WALK_PITCH, WALK_YAW = 0.66, 0.4, 0.3  # m, rad, rad: lowest, most bent, most turned while stepping
STEPS_TO_SQUARE_UP = 1.0  # gait periods walked in place after the command stops, so that both feet end under the hips

# Grid of the quasi-static table and its axes: pelvis height [m] and torso pitch [rad].
TABLE_HEIGHTS = np.linspace(0.40, 0.76, 10)
TABLE_PITCHES = np.linspace(-0.3, 1.2, 11)


def admissible(goal: np.ndarray, current: np.ndarray, standing: np.ndarray) -> np.ndarray:
    """Return what of a command can be followed now: first stand, then bend; first rise, then walk.

    A robot that squats or bends deeply ignores velocities; one that steps stays high and nearly upright.

    Args:
        goal: (N, 7 or more) command.
        current: (N, 7) slewed command.
        standing: (N,) bool, whether the clock rests.

    Returns:
        (N, 7) the command to slew towards.
    """
    goal = goal[:, :7].copy()
    bent = (current[:, 3] < WALK_HEIGHT - 0.01) | (current[:, 5] > WALK_PITCH + 0.02) | (current[:, 5] < -0.12)
    goal[bent, :3] = 0.0
    steps = ~standing
    goal[:, 3] = np.where(steps, np.maximum(goal[:, 3], WALK_HEIGHT), goal[:, 3])
    goal[:, 4] = np.where(steps, 0.0, goal[:, 4])
    goal[:, 5] = np.where(steps, np.clip(goal[:, 5], -0.1, WALK_PITCH), goal[:, 5])
    goal[:, 6] = np.where(steps, np.clip(goal[:, 6], -WALK_YAW, WALK_YAW), goal[:, 6])
    return goal


def slew(current: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Move the first seven numbers of a command towards their goal at a bounded rate, (N, 7) -> (N, 7)."""
    step = SLEW * CONTROL_DT
    return current + np.clip(goal - current, -step, step)


def advance_clock(
    phase: np.ndarray, stopped: np.ndarray, standing: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Advance the gait clock by one control tick.

    Args:
        phase: (N,) in [0, 1).
        stopped: (N,) gait periods since the command last asked to walk.
        standing: (N,) bool, whether the clock rests.
        velocity: (N, 3) commanded velocity.

    Returns:
        The new phase, stopped and standing.
    """
    tick = CONTROL_DT / GAIT.period_s
    walk = (np.abs(velocity) > WALK_THRESHOLD).any(axis=1)
    stopped = np.where(walk, 0.0, np.minimum(stopped + tick, 10.0))
    moved = (phase + tick) % 1.0
    both_down = (moved % 0.5) >= GAIT.swing
    stands = ~walk & (standing | ((stopped >= STEPS_TO_SQUARE_UP) & both_down))
    rest = np.where(standing, phase, np.where(moved < 0.5, REST_PHASES[0], REST_PHASES[1]))
    return np.where(stands, rest, moved), stopped, stands


def pelvis_pitch(torso_pitch: np.ndarray) -> np.ndarray:
    """Return the pelvis pitch [rad] of a torso pitch: the waist takes 0.6 of it within its comfortable range."""
    return torso_pitch - np.clip(0.6 * torso_pitch, -0.35, 0.4)


def leg_ik(forward: np.ndarray, down: np.ndarray, pitch: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve the planar leg: hip-to-ankle vector in the heading frame -> hip pitch, knee, ankle pitch [rad].

    Args:
        forward: Ankle ahead of the hip [m].
        down: Ankle below the hip [m].
        pitch: Pelvis pitch [rad]. The sole stays level.
    """
    upper, lower = g1.THIGH_LENGTH, g1.SHANK_LENGTH
    distance = np.clip(np.sqrt(forward * forward + down * down), 0.22, upper + lower - 0.004)
    knee = np.pi - np.arccos(np.clip((upper**2 + lower**2 - distance**2) / (2 * upper * lower), -1, 1))
    lean = np.arccos(np.clip((upper**2 + distance**2 - lower**2) / (2 * upper * distance), -1, 1))
    hip_world = -np.arctan2(forward, down) - lean
    return hip_world - pitch, knee, -(hip_world + knee)


def swing_state(phase: np.ndarray, standing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which feet should be in the air (N, 2) bool and how high their soles should be (N, 2) [m]; left, right."""
    own = (phase[:, None] + np.array([0.0, 0.5])) % 1.0
    swing = (own < GAIT.swing) & ~standing[:, None]
    return swing, np.where(swing, GAIT.lift * np.sin(np.pi * own / GAIT.swing) ** 2, 0.0)


class Reference:
    """The reference pose of legs and waist.

    Args:
        shift_table: (len(TABLE_HEIGHTS), len(TABLE_PITCHES)) how far [m] the ankles stand ahead of the hips.
    """

    def __init__(self, shift_table: np.ndarray) -> None:
        self.shift_table = np.array(shift_table, dtype=np.float64)

    def ankle_shift(self, height: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Interpolate the quasi-static table, (N,), (N,) -> (N,) [m]."""
        row = np.clip(
            (height - TABLE_HEIGHTS[0]) / (TABLE_HEIGHTS[1] - TABLE_HEIGHTS[0]), 0, len(TABLE_HEIGHTS) - 1.001
        )
        column = np.clip(
            (pitch - TABLE_PITCHES[0]) / (TABLE_PITCHES[1] - TABLE_PITCHES[0]), 0, len(TABLE_PITCHES) - 1.001
        )
        i, j = row.astype(int), column.astype(int)
        u, v = row - i, column - j
        table = self.shift_table
        return (1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * (
            (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
        )

    def __call__(self, command: np.ndarray, phase: np.ndarray, standing: np.ndarray) -> np.ndarray:
        """Return the joint targets of legs and waist.

        Args:
            command: (N, 7 or more) velocity, torso height, roll, pitch, yaw.
            phase: (N,) gait clock.
            standing: (N,) bool.

        Returns:
            (N, 15) [rad], in the order of ``g1.BODY_JOINTS``.
        """
        vx, vy, yaw_rate, height, roll, pitch, yaw = command[:, :7].T
        tilt = pelvis_pitch(pitch)
        shift = self.ankle_shift(height, pitch)
        walking = ~standing
        targets = np.zeros((len(command), NUM_LOWER))
        half_stride = 0.5 * (1 - GAIT.swing) * GAIT.period_s  # s: from mid-stance to lift-off
        sway = np.where(walking, GAIT.sway * np.sin(2 * np.pi * (phase + 0.05)), 0.0)
        for side in (0, 1):
            own = (phase + 0.5 * side) % 1.0
            u = np.clip(own / GAIT.swing, 0, 1)
            swings = own < GAIT.swing
            progress = np.where(swings, -1 + 2 * u * u * (3 - 2 * u), 1 - 2 * (own - GAIT.swing) / (1 - GAIT.swing))
            progress = np.where(walking, progress, 0.0) * half_stride
            lift = np.where(swings & walking, GAIT.lift * np.sin(np.pi * u) ** 2, 0.0)
            down = height - g1.HIP_DROP - g1.SOLE_DROP - lift
            hip, knee, ankle = leg_ik(vx * progress + shift, down, tilt)
            spread = np.arctan2(vy * progress + sway, down)
            first = 6 * side
            targets[:, first : first + 6] = np.stack([hip, spread, yaw_rate * progress, knee, ankle, -spread], axis=1)
        targets[:, 12], targets[:, 13], targets[:, 14] = yaw, roll, pitch - tilt
        return targets
