"""Steps of 0.1 s -> the same steps against the wall clock: five ticks of 20 ms, each begun when it is due.

The bits are those of ``Simulation.step``, which does all the work; here it only waits between its ticks. A machine that
falls behind does not hurry to catch up: the world then runs late, and says by how much.
"""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.timing import CONTROL_DT, STEP_DT, TICKS

MAX_LAG_S = 0.1  # a world later than this begins a new schedule
WINDOW = 100  # steps over which the pace is averaged (10 s)


def body_poses(sim: Simulation) -> np.ndarray:
    """Return the poses (bodies, 7) float32 of all bodies of one world now, also between the ticks of a step.

    Position [m], then quaternion wxyz.
    """
    data = sim.mj_data()
    return np.concatenate([data.xpos, data.xquat], axis=1, dtype=np.float32)


class RealTimeWorld:
    """Runs one world no faster than the clock.

    Args:
        sim: The world; its ``on_tick`` is taken.
        clock: Returns the time [s].
        sleep: Waits for a time [s].

    Attributes:
        late_s: Time that the world has lost against the clock since ``start`` [s].
        after_tick: Called after each controller tick with its number within the step, from 0.
    """

    def __init__(
        self,
        sim: Simulation,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.sim, self._clock, self._sleep = sim, clock, sleep
        self.after_tick: Callable[[int], None] = lambda _tick: None
        sim.on_tick = lambda _worlds, _commands: self._ticked()
        self.late_s = 0.0
        self._due: float | None = None  # when the present step began, or should have
        self._ticks = 0  # computed of the present step
        self._begun: deque[float] = deque(maxlen=WINDOW + 1)

    def start(self) -> None:
        """Begin a new schedule, as after a pause: the next step is due now."""
        self._due = None
        self._begun.clear()

    def wait(self) -> None:
        """Wait until the next step is due: look at the operator after this, not before."""
        now = self._clock()
        due = now if self._due is None else self._due + STEP_DT
        if now < due:
            self._sleep(due - now)
        elif now - due > MAX_LAG_S:
            self.late_s += now - due
            due = now
        self._due, self._ticks = due, 0
        self._begun.append(self._clock())

    def step(self, wanted: np.ndarray) -> StepResult:
        """Apply one command (23,) for 0.1 s of the clock; returns when its last tick has been computed."""
        if self._due is None or self._ticks > 0:
            self.wait()
        return self.sim.step(np.asarray(wanted, dtype=np.float64).reshape(1, command.SIZE))

    @property
    def factor(self) -> float:
        """Time of the world over time of the clock, of the last 10 s; 1 before there is anything to measure."""
        if len(self._begun) < 2 or self._begun[-1] <= self._begun[0]:
            return 1.0
        return (len(self._begun) - 1) * STEP_DT / (self._begun[-1] - self._begun[0])

    def _ticked(self) -> None:
        """Show what a tick has done, and wait until the next one is due."""
        self.after_tick(self._ticks % TICKS)
        self._ticks += 1
        if self._due is None or self._ticks >= TICKS:
            return
        ahead = self._due + self._ticks * CONTROL_DT - self._clock()
        if ahead > 0.0:
            self._sleep(ahead)
