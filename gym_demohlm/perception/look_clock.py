"""Looks at worlds, whenever they come -> the time between them by the worlds' own clocks.

An environment looks once a step of 0.1 s, a deployment 25 times a second. Times are counted in such steps, so that what
is told once a step stays as it is, bit by bit.
"""

import numpy as np

from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT

_DIGITS = 3  # of a step: finer than physics, coarser than the error of a sum of its steps


class LookClock:
    """Remembers when each world was looked at.

    Args:
        num_worlds: N of the simulation.
    """

    def __init__(self, num_worlds: int) -> None:
        self._last_s = np.full(num_worlds, np.nan)

    def begin(self, rows: np.ndarray) -> None:
        """Forget some worlds (n,), whose episodes begin."""
        self._last_s[rows] = np.nan

    def steps(self, sim: Simulation, rows: np.ndarray) -> np.ndarray:
        """Look at some worlds (n,); returns the times since the last look (n,), in steps of 0.1 s, 1 at the first."""
        now_s = sim.time[rows]
        since_s = np.maximum(now_s - self._last_s[rows], 0.0)
        self._last_s[rows] = now_s
        return np.where(np.isnan(since_s), 1.0, np.round(since_s / STEP_DT, _DIGITS))
