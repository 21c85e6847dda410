"""The controller's trials: every disturbance changes the world it says it changes."""

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.wbc.evaluation.trial import DelayedController, Disturbance, trial_simulation, trial_task


def _total_mass(disturbance: Disturbance | None) -> float:
    return float(Simulation(trial_task(disturbance)).model.body_subtreemass[1])


def test_loads_weigh_what_they_say() -> None:
    empty = _total_mass(None)
    assert _total_mass(Disturbance(hand_loads=(1.5, 0.5))) == pytest.approx(empty + 2.0)
    assert _total_mass(Disturbance(torso_load=3.0)) == pytest.approx(empty + 3.0)


def test_friction_reaches_soles_and_floor() -> None:
    model = Simulation(trial_task(Disturbance(friction=0.4))).model
    assert model.geom("floor").friction[0] == 0.4
    assert model.geom("left_foot_point_0").friction[0] == 0.4


def test_delay_hands_out_the_targets_of_the_tick_before() -> None:
    rng = np.random.default_rng(0)
    prompt, late = trial_simulation(2).controller, DelayedController(2, delay_ticks=1)
    quat, still = np.tile([1.0, 0, 0, 0], (2, 1)), np.zeros((2, 3))
    commands = np.tile(command.rest(), (2, 1))
    before = np.tile(g1.HOME, (2, 1))
    for controller in (prompt, late):
        controller.reset(np.arange(2), quat, still, before, 0 * before)
    for _ in range(3):
        q = g1.HOME + rng.normal(0, 0.05, (2, 29))
        assert np.array_equal(late.step(quat, still, q, 0 * q, commands), before)
        before = prompt.step(quat, still, q, 0 * q, commands)


def test_a_finer_timestep_takes_more_steps_for_the_same_time() -> None:
    simulation = trial_simulation(1, Disturbance(timestep=0.001))
    simulation.step(command.rest()[None])
    assert simulation.time[0] == pytest.approx(0.1)
    assert simulation.readings("left_knee_torque")[1].shape == (1, 100, 1)


def test_readings_belong_to_the_worlds_that_were_stepped() -> None:
    simulation = trial_simulation(3)
    simulation.step(np.tile(command.rest(), (3, 1)), active=np.array([True, False, True]))
    worlds, touch = simulation.readings("left_sole_touch")
    assert worlds.tolist() == [0, 2]
    assert touch.shape == (2, 50, 1)
    assert (touch[:, -10:].mean(axis=1) > 50).all()  # N: a foot bears about half of 327 N
    with pytest.raises(UnknownNameError, match="left_sole_touch"):
        simulation.readings("left_sole_tuch")
