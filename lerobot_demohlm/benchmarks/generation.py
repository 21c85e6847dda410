"""Attempts at a task on one core -> CPU seconds an attempt, where they go, and episodes an hour and core.

Or attempts in worlds that vary and in plain ones -> how fast each kind of world is.

All that a worker does is counted: commands, inverse kinematics, controller, physics, judging, and writing the successes
as LeRobot datasets. What a worker does once is not: compiling the scene, loading demonstration and compiled kernels.
"""

import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.simulation import Pool, Simulation, make_pool
from gym_demohlm.task import Task
from gym_demohlm.timing import PHYSICS_DT
from gym_demohlm.variation import get_variation
from lerobot_demohlm.benchmarks.stopwatch import Stopwatch
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.datasets.writer import write_dataset
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.request import BLOCK_SIZE
from lerobot_demohlm.generation.stages import Settings


def measure(
    task: Task,
    region: str,
    seed: int,
    num_attempts: int,
    demonstration: Path | None = None,
    controller: str | None = None,
) -> dict[str, Any]:
    """Make attempts in blocks, as a worker does, and return what they took.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        num_attempts: How many, 1 or more.
        demonstration: Directory of the demonstration; the packaged one by default.
        controller: Name, path or hash of the whole-body controller; the default one by default.
    """
    watch, pool = Stopwatch(), make_pool(1)
    sim = Simulation(task.at(region), BLOCK_SIZE, controller=controller, pool=pool)
    plain = Settings(variation=PLAIN)  # as in all earlier measurements
    attempts = Attempts(task, demonstrations.load(demonstration, task), region, seed, settings=plain, sim=sim)
    attempts.run([0])  # it loads what is loaded once
    watch.watch(pool, "rollout", "mj_step")
    watch.watch(sim.controller, "step", "controller")
    watch.watch(attempts.ik, "solve", "inverse_kinematics")
    successes, simulated, after_first = 0, 0.0, 0.0
    began = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        for first in range(0, num_attempts, BLOCK_SIZE):
            episodes = attempts.run(range(first, min(first + BLOCK_SIZE, num_attempts)))
            simulated += sum(episode.length_s for episode in episodes)
            kept = [episode for episode in episodes if episode.outcome == "success"]
            successes += len(kept)
            if kept:
                before = time.process_time()
                write_dataset(Path(scratch) / str(first), "local/block", kept)
                watch.seconds["writing"] += time.process_time() - before
            after_first = after_first or _peak_mb()
    total = time.process_time() - began
    attempts.close()
    shares = {f"{name}_share": round(seconds / total, 4) for name, seconds in watch.seconds.items()}
    return {
        "task": task.name,
        "region": region,
        "seed": seed,
        "stamp": portability.stamp(task),
        "attempts": num_attempts,
        "successes": successes,
        "cpu_s_per_attempt": round(total / num_attempts, 3),
        "seconds_per_episode": round(total / max(successes, 1), 3),
        "simulated_s_per_episode": round(simulated / max(successes, 1), 2),
        "us_per_mj_step": round(1e6 * watch.seconds["mj_step"] * PHYSICS_DT / simulated, 1),
        **shares,
        "python_share": round(1.0 - sum(watch.seconds.values()) / total, 4),
        "episodes_per_hour_per_core": round(3600.0 * successes / total, 1),
        "rss_growth_mb": round(_peak_mb() - after_first, 1),
    }


def compare(
    task: Task,
    region: str,
    seed: int,
    num_attempts: int,
    variation: str,
    demonstration: Path | None = None,
    controller: str | None = None,
) -> dict[str, Any]:
    """Make attempts in worlds that vary and in plain ones, in turns of a block, and return how fast both are.

    Speed is physics steps a second of CPU time. All that an attempt does is counted, also making its world's model, but
    not writing its episode.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        num_attempts: How many of each, 1 or more.
        variation: How worlds vary.
        demonstration: Directory of the demonstration; the packaged one by default.
        controller: Name, path or hash of the whole-body controller; the default one by default.

    Raises:
        UnknownNameError: No such variation.
    """
    loaded = demonstrations.load(demonstration, task)
    sides = {}
    for side, worlds in (("varied", variation), ("plain", "none")):
        pool = _Counter(make_pool(1))
        sim = Simulation(task.at(region), BLOCK_SIZE, 1, controller, pool, get_variation(worlds))
        settings = Settings(variation=replace(PLAIN, variation=worlds))
        sides[side] = pool, Attempts(task, loaded, region, seed, settings=settings, sim=sim)
    for pool, attempts in sides.values():
        attempts.run([0])  # it loads what is loaded once
        pool.steps = 0
    seconds, successes = dict.fromkeys(sides, 0.0), dict.fromkeys(sides, 0)
    for first in range(0, num_attempts, BLOCK_SIZE):
        for side, (_, attempts) in sides.items():
            began = time.process_time()
            episodes = attempts.run(range(first, min(first + BLOCK_SIZE, num_attempts)))
            seconds[side] += time.process_time() - began
            successes[side] += sum(episode.outcome == "success" for episode in episodes)
    speeds = {side: pool.steps / seconds[side] for side, (pool, _) in sides.items()}
    for _, attempts in sides.values():
        attempts.close()
    return {
        "task": task.name,
        "region": region,
        "seed": seed,
        "stamp": portability.stamp(task),
        "variation": variation,
        "attempts": num_attempts,
        "successes": successes["varied"],
        "plain_successes": successes["plain"],
        "steps_per_s": round(speeds["varied"]),
        "plain_steps_per_s": round(speeds["plain"]),
        "speed": round(speeds["varied"] / speeds["plain"], 4),
    }


class _Counter:
    """Passes rollouts on to a pool and counts their steps."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.steps = 0

    def rollout(self, models: Any, data: Any, initial: np.ndarray, control: np.ndarray, **options: Any) -> None:  # noqa: ANN401
        self.steps += control.shape[0] * control.shape[1]  # worlds, steps of each
        self.pool.rollout(models, data, initial, control, **options)

    def close(self) -> None:
        self.pool.close()


def _peak_mb() -> float:
    """Return the largest memory that this process has held so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
