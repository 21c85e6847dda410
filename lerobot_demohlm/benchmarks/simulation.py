"""A task -> physics steps a second of ``Simulation.step``, and of MuJoCo's step alone over the same states.

The worlds go through the task's demonstration. Each second of it is made twice, in turns: by the simulation, with
controller, gaze, contact forces and poses; and by handing the very same states and controls to ``mujoco.rollout``,
which is ``mj_step`` in a loop in C, on as many threads. Both must end in the same bits.
"""

import time
from typing import Any

import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.simulation import Pool, Simulation, make_pool
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.demonstrations import demonstration as demonstrations

TURN = 10  # commands, a second


class _Recorder:
    """Passes rollouts on to a pool; while ``calls`` is a list, it keeps what they were asked and what they answered."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.calls: list[tuple[tuple[Any, ...], dict[str, Any], np.ndarray]] | None = None

    def rollout(self, models: Any, data: Any, initial: np.ndarray, control: np.ndarray, **options: Any) -> None:  # noqa: ANN401
        if self.calls is None:
            self.pool.rollout(models, data, initial, control, **options)
            return
        inputs = (models, data, initial.copy(), control.copy())
        self.pool.rollout(*inputs, **options)
        self.calls.append((inputs, options, options["state"].copy()))

    def close(self) -> None:
        self.pool.close()


def measure(task: Task, num_worlds: int, num_threads: int, controller: str | None = None) -> dict[str, Any]:
    """Return steps a second of both and their ratio.

    Args:
        task: The task.
        num_worlds: Worlds stepped together, all alike.
        num_threads: Of the physics; with one, CPU time is measured, which other processes do not change.
        controller: Name, path or hash of the whole-body controller; the default one by default.

    Raises:
        SceneError: The two ways end in different states.
    """
    clock = time.process_time if num_threads == 1 else time.perf_counter
    demonstration = demonstrations.load(None, task)
    pool = _Recorder(make_pool(min(num_threads, num_worlds)))
    sim = Simulation(task, num_worlds, num_threads, controller, pool)
    sim.restore({name: np.repeat(values, num_worlds, axis=0) for name, values in demonstration.start.items()})
    commands = np.repeat(demonstration.action[:, None].astype(np.float64), num_worlds, axis=1)
    seconds = {"simulation": 0.0, "mj_step": 0.0}
    for first in range(0, len(commands), TURN):
        before, turn = sim.snapshot(), commands[first : first + TURN]
        pool.calls = calls = []
        for command in turn:
            sim.step(command)
        pool.calls = None
        sim.restore(before)

        began = clock()
        for command in turn:
            sim.step(command)
        seconds["simulation"] += clock() - began

        began = clock()
        for inputs, options, _ in calls:
            pool.pool.rollout(*inputs, **options)
        seconds["mj_step"] += clock() - began
        _, options, recorded = calls[-1]
        end = sim.snapshot()["physics"]
        if not np.array_equal(options["state"], recorded) or not np.array_equal(recorded[:, -1], end):
            raise SceneError("other states by MuJoCo's step alone", "the simulation's, bit for bit", "report a bug")
    sim.close()
    steps = len(commands) * num_worlds * round(STEP_DT / sim.model.opt.timestep)
    return {
        "task": task.name,
        "num_worlds": num_worlds,
        "num_threads": num_threads,
        "steps": steps,
        "steps_per_s": round(steps / seconds["simulation"]),
        "mj_steps_per_s": round(steps / seconds["mj_step"]),
        "step_efficiency": round(seconds["mj_step"] / seconds["simulation"], 4),
    }
