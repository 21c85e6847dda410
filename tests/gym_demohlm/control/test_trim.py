"""The slow correction of a command: to the command and no further, never past its bounds, gone on the way."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from gym_demohlm.control import attitude, command, trim
from gym_demohlm.control.settings import UNTRIMMED, Trim
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT
from gym_demohlm.wbc.evaluation.episodes import tracked
from gym_demohlm.wbc.evaluation.trial import trial_task

_CONSTANT = np.ones((1, 5), dtype=bool)


def test_a_constant_error_is_corrected() -> None:
    told, bias, correction = (
        np.array([[0.5, 0.6, 0.1, 0.5, -0.3]]),
        np.array([[0.1, -0.02, 0.03, 0.05, 0.02]]),
        np.zeros((1, 5)),
    )
    for _ in range(round(12.0 / CONTROL_DT)):
        correction = trim.advance(correction, told, told + correction + bias, _CONSTANT, Trim())
    np.testing.assert_allclose(correction, -bias, atol=2e-4)


def test_what_does_as_it_is_told_is_left_alone() -> None:
    told = np.array([[0.5, 0.6, 0.1, 0.5, -0.3]])
    assert (trim.advance(np.zeros((1, 5)), told, told, _CONSTANT, Trim()) == 0).all()


def test_a_torso_that_is_held_back_stays_within_bounds_and_forgets() -> None:
    told, correction = np.array([[0.5, 0.6, 0.1, 0.5, -0.3]]), np.zeros((1, 5))
    for _ in range(1000):
        correction = trim.advance(correction, told, told - 1.0, _CONSTANT, Trim())
    np.testing.assert_allclose(correction[0], np.array(Trim().limits))
    for _ in range(round(2.0 / CONTROL_DT)):
        correction = trim.advance(correction, told, told - 1.0, ~_CONSTANT, Trim())
    assert (np.abs(correction) < 0.03 * np.array(Trim().limits)).all()


def test_roll_and_pitch_are_those_of_the_attitude() -> None:
    angles = np.random.default_rng(0).uniform([-3, -1.4, -1.4], [3, 1.4, 1.4], (50, 3))  # yaw, pitch, roll
    down = Rotation.from_euler("ZYX", angles).inv().apply([0.0, 0.0, -1.0])
    roll, pitch = attitude.roll_pitch(down)
    np.testing.assert_allclose(np.column_stack([pitch, roll]), angles[:, 1:], atol=1e-9)


def _simulation(settings: Trim, num_worlds: int) -> Simulation:
    controller = WholeBodyController(num_worlds)
    controller.settings = replace(controller.settings, trim=settings)
    return Simulation(trial_task(), num_worlds, controller=controller)


def test_a_standing_robot_ends_nearer_to_its_command() -> None:
    told = np.tile(command.rest(), (4, 1))
    told[:, [command.HEIGHT, command.PITCH]] = [[0.74, 0.0], [0.65, 0.3], [0.60, 0.5], [0.70, -0.1]]
    errors = []
    for settings in (UNTRIMMED, Trim()):
        simulation = _simulation(settings, num_worlds=4)
        simulation.reset([simulation.task.default_state()] * 4)
        for _ in range(50):
            simulation.step(told)
        found = tracked(simulation)
        errors.append(
            np.abs(found["height"] - told[:, command.HEIGHT]) + np.abs(found["pitch"] - told[:, command.PITCH])
        )
    without, with_trim = errors
    assert with_trim.mean() < 0.5 * without.mean()


def test_a_turning_robot_turns_as_fast_as_told() -> None:
    told = np.tile(command.rest(), (4, 1))
    told[:, 2] = [0.8, -0.8, 0.5, -1.0]
    errors = []
    for settings in (UNTRIMMED, Trim()):
        simulation = _simulation(settings, num_worlds=4)
        simulation.reset([simulation.task.default_state()] * 4)
        turned = []
        for step in range(60):
            simulation.step(told)
            if step >= 60 - 32:  # five gait periods
                turned.append(tracked(simulation)["yaw_rate"])
        errors.append(np.abs(np.mean(turned, axis=0) - told[:, 2]))
    without, with_trim = errors
    assert with_trim.mean() < 0.6 * without.mean()
