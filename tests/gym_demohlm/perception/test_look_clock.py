"""The time between looks, by the worlds' clocks."""

import numpy as np

from gym_demohlm.perception.look_clock import LookClock
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from tests.helpers.clocks import set_time


def test_steps_of_a_simulation_are_exactly_one_and_looks_at_other_times_are_shares_of_them() -> None:
    sim, clock, row = Simulation(get_task("LiftBox")), LookClock(1), np.array([0])
    assert clock.steps(sim, row) == 1.0  # the first
    for _ in range(30):
        sim.step(sim.command)
        assert clock.steps(sim, row)[0] == 1.0
    assert clock.steps(sim, row) == 0.0  # the same world again
    begin_s = float(sim.time[0])
    for index in range(1, 60):
        set_time(sim, begin_s + 0.04 * index)
        assert clock.steps(sim, row)[0] == 0.4
    set_time(sim, 0.0)
    assert clock.steps(sim, row) == 0.0  # a world that was brought back to an earlier time
    clock.begin(row)
    assert clock.steps(sim, row) == 1.0
    sim.close()
