"""Worlds whose clock is set, for what counts time by it."""

from gym_demohlm.simulation import Simulation


def set_time(sim: Simulation, time_s: float) -> None:
    """Set the clock of all worlds [s]; nothing else changes."""
    snapshot = sim.snapshot()
    snapshot["physics"][:, 0] = time_s
    sim.restore(snapshot)
