"""A commanded velocity -> the velocity to give to the policy, so that the robot walks at the commanded one.

A policy walks too slowly on average, and its error changes as the robot turns, squats or bends: its reward is for the
velocity at each moment, not for the mean. For one command the error hardly varies from cycle to cycle. A polynomial of
the command removes most of it. ``wbc.evaluation.calibration`` fits it, and the weights file holds it. It is zero for a
robot that stands.
"""

import itertools

import numpy as np

from gym_demohlm.control import features
from gym_demohlm.robot import g1

DEGREE = 3
CENTRE = np.array([0.0, 0.0, 0.0, g1.PELVIS_HEIGHT - 0.06, 0.0])
"""Subtracted from forward and sideways velocity [m/s], yaw rate [rad/s], torso height [m] and torso pitch [rad]."""
SCALE = 1.0 / np.array([0.6, 0.4, 1.0, 0.08, 0.3])
"""Factors that make these five numbers about one where robots walk."""
INDEX = np.array([0, 1, 2, 3, 5])
"""Where these five numbers are in a command."""
BOUND = 1.6
"""Largest magnitude of the five scaled numbers: the polynomial is not asked beyond it."""
LARGEST = 0.25
"""Largest correction of each velocity [m/s]."""
TERMS = np.array(
    [
        [*term, *[len(INDEX)] * (DEGREE - len(term))]
        for degree in range(1, DEGREE + 1)
        for term in itertools.combinations_with_replacement(range(len(INDEX)), degree)
        if term[0] < 3  # each term holds a velocity: nothing is added where none is commanded
    ]
)
"""Factors of each term, (NUM_TERMS, DEGREE): columns of the five numbers, and a sixth column of ones."""
NUM_TERMS = len(TERMS)
_SIGNS = np.array(features.COMMAND_MIRROR[1])  # of a command in the mirror


def coefficients(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """Return the coefficients in a controller's settings as an array, (2, NUM_TERMS) [m/s]; (0, NUM_TERMS) for none."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), NUM_TERMS)


def terms(command: np.ndarray) -> np.ndarray:
    """Return the terms of the polynomial.

    Args:
        command: (N, 7) velocity and torso.

    Returns:
        (N, NUM_TERMS), no unit.
    """
    scaled = np.clip((command[:, INDEX] - CENTRE) * SCALE, -BOUND, BOUND)
    columns = np.concatenate([scaled, np.ones((len(scaled), 1))], axis=1)
    found = columns[:, TERMS[:, 0]]
    for factor in range(1, DEGREE):
        found = found * columns[:, TERMS[:, factor]]
    return found


def further(chosen: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return what to add to the commanded velocity before the policy gets it.

    Args:
        chosen: (2, NUM_TERMS) coefficients of the forward and sideways velocity [m/s]; (0, NUM_TERMS) adds nothing.
        command: (N, 7) velocity and torso.

    Returns:
        (N, 2) [m/s], or (N, 0).
    """
    found = terms(command)
    total = np.zeros((len(command), len(chosen)))
    for term in range(NUM_TERMS):  # one after another, as a compiled kernel sums them
        total += found[:, term : term + 1] * chosen[:, term]
    return np.clip(total, -LARGEST, LARGEST)


def fit(told: np.ndarray, walked: np.ndarray, ridge: float = 0.1) -> np.ndarray:
    """Return the coefficients by which robots walk with the velocity that is commanded.

    What was told is fitted as a function of what came of it: told - walked = polynomial(walked). Each robot counts with
    its mirror image, so that left and right are treated alike.

    Args:
        told: (N, 7) constant commands of robots that walked.
        walked: (N, 2) their mean forward and sideways velocity in the heading frame [m/s].
        ridge: Weight of the squared coefficients.

    Returns:
        (2, NUM_TERMS) [m/s].
    """
    came, missing = np.concatenate([walked, told[:, 2:]], axis=1), told[:, :2] - walked
    found = terms(np.concatenate([came, came * _SIGNS]))
    missing = np.concatenate([missing, missing * _SIGNS[:2]])
    normal = found.T @ found + ridge * np.eye(NUM_TERMS)
    return np.linalg.solve(normal, found.T @ missing).T
