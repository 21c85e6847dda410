"""The posture that a robot starts in: as its conditions say, and not in its own way."""

import numpy as np
import pytest

from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.posture import towards_rest
from gym_demohlm.variation import get_variation

FIRST = "8ac4c8cd0008"
ELBOW = g1.ARM_JOINTS.index("left_elbow")


def _started(controller: str, arms: np.ndarray) -> np.ndarray:
    """Return how far a robot's arms (14,) [rad] are from rest when it was asked to start with them there."""
    sim = Simulation(get_task("ExchangeCube"), controller=controller, variation=get_variation("hard:start"))
    sim.reset([sim.task.default_state() | {"start.arms": arms.tolist(), "start.waist": [0.0]}])
    found = sim.joint_positions[0] - g1.HOME
    sim.close()
    return found[[g1.BODY_JOINTS.index(joint) for joint in g1.ARM_JOINTS]]


def test_postures_come_nearer_to_rest_and_end_there() -> None:
    posture = g1.HOME + 0.3
    tried = list(towards_rest(posture))
    away = [np.abs(each - g1.HOME).max() for each in tried]
    assert np.array_equal(tried[0], posture) and np.array_equal(tried[-1], g1.HOME)
    assert away == sorted(away, reverse=True) and len(set(away)) == len(away)


@pytest.mark.parametrize("controller", [DEFAULT, FIRST])
def test_a_posture_that_is_clear_is_kept(controller: str) -> None:
    arms = np.zeros(len(g1.ARM_JOINTS))
    arms[ELBOW] = -0.2  # the forearm further up
    np.testing.assert_allclose(_started(controller, arms), arms, atol=1e-12)


def test_a_hand_inside_a_hip_is_drawn_back_where_the_two_stop_each_other() -> None:
    left = [0.183, -0.024, -0.117, 0.199, -0.172, -0.029, -0.196]  # rad: the left hand 3 cm inside the hip
    arms = np.array([*left, *[0.0] * 7])
    asked = np.where(np.arange(14) == 1, 0.024, arms)  # the shoulder rolls outwards only
    np.testing.assert_allclose(_started(FIRST, arms), asked, atol=1e-12)
    found = _started(DEFAULT, arms)
    share = found[0] / asked[0]
    assert share < 1.0
    np.testing.assert_allclose(found, share * asked, atol=1e-12)
