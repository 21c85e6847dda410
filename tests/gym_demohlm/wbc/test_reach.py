"""Targets are poses that the robot can take, hands take turns, mean frames are free of sway."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from gym_demohlm.wbc.evaluation import reach
from gym_demohlm.wbc.evaluation.commanded_posture import Figure
from gym_demohlm.wbc.evaluation.trial import trial_simulation


@pytest.fixture(scope="module")
def figure() -> Figure:
    simulation = trial_simulation(1)
    simulation.close()
    return Figure(simulation.model, Weights().make_reference())


def test_an_obedient_robot_stands_on_level_soles_at_the_commanded_height(figure: Figure) -> None:
    wanted = command.rest()
    wanted[command.TORSO] = [0.55, 0.1, 0.6, 0.3]
    figure.stand(wanted)
    soles = [figure.data.site(f"{side}_sole") for side in g1.SIDES]
    for sole in soles:
        assert sole.xmat[8] > 0.999 and abs(sole.xpos[2]) < 0.015
    assert figure.pelvis()[2] == 0.55
    roll, pitch, _ = poses.rpy(figure.data.body("torso_link").xmat.reshape(3, 3))
    np.testing.assert_allclose([roll, pitch], [0.1, 0.6], atol=0.02)


def test_targets_are_drawn_by_the_seed_alone_and_spread(figure: Figure) -> None:
    first, second = (reach.draw_targets(figure, 12, np.random.default_rng(4), candidates=150) for _ in range(2))
    assert np.array_equal(first, second)
    assert (first[..., 0, 3] > 0.15).all() and (first[..., 2, 3] > 0.05).all()
    assert first[..., 2, 3].std() > 0.1 and len(np.unique(first[:, 0, 0, 3])) > 6


def test_both_hands_then_one_by_turns() -> None:
    np.testing.assert_array_equal(reach.hands_of(5), [[1, 1], [1, 0], [1, 1], [0, 1], [1, 1]])


def test_mean_frames_are_free_of_the_gaits_sway() -> None:
    time = 0.002 * np.arange(2000)
    pelvis = np.zeros((1, 2000, 7))
    pelvis[0, :, 0] = 0.25 * time
    pelvis[0, :, 1] = 0.03 * np.sin(2 * np.pi * np.arange(2000) / reach.GAIT_SAMPLES)
    pelvis[0, :, 3] = 1.0
    frames = reach._mean_frames(pelvis)[0, 400:-400]
    np.testing.assert_allclose(frames[:, 1, 3], 0.0, atol=1e-4)
    np.testing.assert_allclose(frames[:, 0, 3], 0.25 * time[400:-400], atol=1e-3)


@pytest.mark.slow
def test_standing_robots_reach_a_target_in_front() -> None:
    simulation = trial_simulation(1)
    error, fallen = reach.reach_map(simulation, np.array([0.3]), np.array([0.8]))
    simulation.close()
    assert not fallen.any() and error.max() < reach.STANDING_TOLERANCE
