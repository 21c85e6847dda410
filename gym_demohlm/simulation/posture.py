"""Conditions of a world -> the posture that its robot starts in, nearer to rest where it would be in its own way."""

from collections.abc import Iterator

import numpy as np

from gym_demohlm.robot import g1
from gym_demohlm.variation import Conditions

ARMS = [g1.BODY_JOINTS.index(joint) for joint in g1.ARM_JOINTS]
"""Of the body joints."""
_SHOULDER_ROLLS = [
    (g1.BODY_JOINTS.index(f"{side}_shoulder_roll"), sign) for side, sign in zip(g1.SIDES, (1, -1), strict=True)
]
_WAIST_YAW = g1.BODY_JOINTS.index("waist_yaw")
_SHARES = (0.75, 0.5, 0.25)  # of the way from rest to a posture


def start_posture(conditions: Conditions, limits: np.ndarray) -> np.ndarray:
    """Return the posture (29,) [rad] in which conditions have a robot start; shoulders roll outwards only.

    Args:
        conditions: Of the world.
        limits: (29, 2) least and largest angle of each of ``g1.BODY_JOINTS`` [rad].
    """
    arms, waist = conditions.numbers("start.arms"), conditions.numbers("start.waist")
    posture = g1.HOME.copy()
    posture[ARMS] += 0.0 if arms is None else np.array(arms)
    for roll, outwards in _SHOULDER_ROLLS:
        posture[roll] = g1.HOME[roll] + outwards * abs(posture[roll] - g1.HOME[roll])
    posture[_WAIST_YAW] += 0.0 if waist is None else waist[0]
    return np.clip(posture, limits[:, 0], limits[:, 1])


def towards_rest(posture: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a posture (29,) [rad], then postures that are nearer and nearer to rest, then rest."""
    yield posture
    for share in _SHARES:
        yield g1.HOME + share * (posture - g1.HOME)
    yield g1.HOME.copy()
