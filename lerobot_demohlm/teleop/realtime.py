"""Steps of 0.1 s -> the same steps against the wall clock: five ticks of 20 ms, each begun when it is due.

The bits are those of ``Simulation.step``, which does all the work; here it only waits between its ticks. A machine that
falls behind does not hurry to catch up: the world then runs late, and says by how much.
"""

import time
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.task import Task
from gym_demohlm.timing import CONTROL_DT, STEP_DT

MAX_LAG_S = 0.1  # a world later than this begins a new schedule
WINDOW = 100  # steps over which the pace is averaged (10 s)


class TickedSimulation(Simulation):
    """One world that can be watched between its ticks.

    Args:
        task: The task.

    Attributes:
        before_tick: Called with the number of a tick within its step before it is computed.
        after_tick: Called with the number of a tick within its step after it.
    """

    def __init__(self, task: Task) -> None:
        self.before_tick: Callable[[int], None] = lambda _tick: None
        self.after_tick: Callable[[int], None] = lambda _tick: None
        super().__init__(task)
        self._drawn = mujoco.MjData(self.model)

    def body_poses(self) -> np.ndarray:
        """Return the poses (bodies, 7) float32 of all bodies now, also between ticks: position [m], quaternion wxyz."""
        data, split = self._drawn, 3 * self.model.nmocap
        mujoco.mj_setState(self.model, data, self._physics[0], mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
        data.mocap_pos[:] = self._mocap[0, :split].reshape(-1, 3)
        data.mocap_quat[:] = self._mocap[0, split:].reshape(-1, 4)
        mujoco.mj_kinematics(self.model, data)
        return np.concatenate([data.xpos, data.xquat], axis=1, dtype=np.float32)

    def _tick(self, tick: int, rows: np.ndarray, commands: np.ndarray) -> np.ndarray:
        self.before_tick(tick)
        sound = super()._tick(tick, rows, commands)
        self.after_tick(tick)
        return sound


class RealTimeWorld:
    """Runs one world no faster than the clock.

    Args:
        sim: The world; its ``before_tick`` is taken.
        clock: Returns the time [s].
        sleep: Waits for a time [s].

    Attributes:
        late_s: Time that the world has lost against the clock since ``start`` [s].
    """

    def __init__(
        self,
        sim: TickedSimulation,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.sim, self._clock, self._sleep = sim, clock, sleep
        sim.before_tick = self._wait_for_tick
        self.late_s = 0.0
        self._due: float | None = None  # when the present step began, or should have
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
        self._due = due
        self._begun.append(self._clock())

    def step(self, wanted: np.ndarray) -> StepResult:
        """Apply one command (23,) for 0.1 s of the clock; returns when its last tick has been computed."""
        if self._due is None:
            self.wait()
        return self.sim.step(np.asarray(wanted, dtype=np.float64).reshape(1, command.SIZE))

    @property
    def factor(self) -> float:
        """Time of the world over time of the clock, of the last 10 s; 1 before there is anything to measure."""
        if len(self._begun) < 2 or self._begun[-1] <= self._begun[0]:
            return 1.0
        return (len(self._begun) - 1) * STEP_DT / (self._begun[-1] - self._begun[0])

    def _wait_for_tick(self, tick: int) -> None:
        if self._due is None:
            return
        ahead = self._due + tick * CONTROL_DT - self._clock()
        if ahead > 0.0:
            self._sleep(ahead)
