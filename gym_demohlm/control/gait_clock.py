"""The gait clock: when a robot steps, with which foot, and how fast.

A commanded velocity starts it, and so does a loss of balance. A robot that was pushed steps wider and faster for a
while.
"""

from typing import NamedTuple

import numpy as np

from gym_demohlm.control.settings import Gait
from gym_demohlm.timing import CONTROL_DT

GAIT = Gait()
REST_PHASES = GAIT.rest_phases
WALK_THRESHOLD = np.array([0.04, 0.04, 0.08])  # m/s, m/s, rad/s: slower commands mean "stand"
STEPS_TO_SQUARE_UP = 1.0  # gait periods walked in place after the command stops, so that both feet end under the hips
# A robot at rest takes steps when its pelvis moves faster than its feet can hold [m/s], or tips over its soles [rad].
STARTLE_SPEED, STARTLE_TILT = np.array([0.25, 0.35]), 0.2
PUSHED_AHEAD = 0.5  # weight of an error along the way in what tells a push: every change of command makes one


class Clock(NamedTuple):
    """A gait clock.

    Attributes:
        phase: (N,) in [0, 1).
        stopped: (N,) gait periods since the command, or a loss of balance, last asked for steps.
        standing: (N,) bool, whether the clock rests.
        recovers: (N,) 1 after a push, down to 0 over ``Gait.recovery_s``; 0 while the clock rests.
    """

    phase: np.ndarray
    stopped: np.ndarray
    standing: np.ndarray
    recovers: np.ndarray


def at_rest(count: int) -> Clock:
    """Return the clocks of robots that have stood still for long."""
    return Clock(np.full(count, REST_PHASES[0]), np.full(count, 2.0), np.ones(count, dtype=bool), np.zeros(count))


def startled(velocity: np.ndarray, sole_tilt: np.ndarray) -> np.ndarray:
    """Return who must step to keep upright (N,) bool, from the odometry: velocity (N, 2) and sole tilt (N,)."""
    return (np.abs(velocity) > STARTLE_SPEED).any(axis=1) | (sole_tilt > STARTLE_TILT)


def escapes(capture: np.ndarray, margins: tuple[float, float, float], sole_tilt: np.ndarray) -> np.ndarray:
    """Return who must step to keep upright, (N,) bool.

    Args:
        capture: (N, 2) from ``Reference.capture`` [m].
        margins: How far it may be ahead, behind and beside [m].
        sole_tilt: (N,) [rad].
    """
    ahead, aside = np.ascontiguousarray(capture.T)
    out = (ahead > margins[0]) | (ahead < -margins[1]) | (np.abs(aside) > margins[2])
    return out | (sole_tilt > STARTLE_TILT)


def pushed(velocity: np.ndarray, command: np.ndarray, gait: Gait = GAIT) -> np.ndarray:
    """Return who moves so differently from the command that it must have been pushed, (N,) bool.

    Args:
        velocity: (N, 2) from the odometry [m/s].
        command: (N, 2 or more) slewed, velocity first [m/s].
        gait: Its ``recovery_speed`` says how differently.
    """
    x, y = np.ascontiguousarray((velocity - command[:, :2]).T)
    x = PUSHED_AHEAD * x
    return x * x + y * y > gait.recovery_speed * gait.recovery_speed


def advance_clock(
    clock: Clock, velocity: np.ndarray, startled: np.ndarray, pushed: np.ndarray, gait: Gait = GAIT
) -> Clock:
    """Advance the gait clock by one control tick.

    Args:
        clock: After the tick before.
        velocity: (N, 3) commanded velocity [m/s, m/s, rad/s].
        startled: (N,) bool, who loses balance.
        pushed: (N,) bool, who was pushed.
        gait: Whose clock it is.

    Returns:
        The clock now.
    """
    phase, stopped, standing, recovers = clock
    if gait.recovery_s:
        recovers = np.where(pushed, 1.0, np.maximum(recovers - CONTROL_DT / gait.recovery_s, 0.0))
    tick = CONTROL_DT / period(recovers, gait)
    walk = (np.abs(velocity) > WALK_THRESHOLD).any(axis=1) | startled
    stopped = np.where(walk, 0.0, np.minimum(stopped + tick, 10.0))
    moved = (phase + tick) % 1.0
    both_down = (moved % 0.5) >= gait.swing
    stands = ~walk & (standing | ((stopped >= STEPS_TO_SQUARE_UP) & both_down))
    rest = np.where(standing, phase, np.where(moved < 0.5, gait.rest_phases[0], gait.rest_phases[1]))
    return Clock(np.where(stands, rest, moved), stopped, stands, np.where(stands, 0.0, recovers))


def recovery_share(recovers: np.ndarray) -> np.ndarray:
    """Return how much of the recovering gait robots walk with (N,): all of it in the first half of their recovery."""
    return np.minimum(2 * recovers, 1.0)


def period(recovers: np.ndarray, gait: Gait = GAIT) -> np.ndarray:
    """Return the time of two steps (N,) [s] of robots with so much of a recovery left (N,), see ``Clock``."""
    return gait.period_s + recovery_share(recovers) * (gait.recovery_period_s - gait.period_s)


def spread(recovers: np.ndarray, gait: Gait = GAIT) -> np.ndarray:
    """Return how far each foot walks beside the middle (N,) [m]; as ``period``."""
    return gait.spread + recovery_share(recovers) * (gait.recovery_spread - gait.spread)


def swing_state(phase: np.ndarray, standing: np.ndarray, gait: Gait = GAIT) -> tuple[np.ndarray, np.ndarray]:
    """Return which feet should be in the air (N, 2) bool and how high their soles should be (N, 2) [m]; left, right."""
    own = (phase[:, None] + np.array([0.0, 0.5])) % 1.0
    swing = (own < gait.swing) & ~standing[:, None]
    return swing, np.where(swing, gait.lift * np.sin(np.pi * own / gait.swing) ** 2, 0.0)
