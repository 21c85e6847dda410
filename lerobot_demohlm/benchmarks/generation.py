"""Attempts at a task on one core -> CPU seconds an attempt, where they go, and episodes an hour and core.

All that a worker does is counted: commands, inverse kinematics, controller, physics, judging, and writing the successes
as LeRobot datasets. What a worker does once is not: compiling the scene, loading demonstration and compiled kernels.
"""

import resource
import tempfile
import time
from pathlib import Path
from typing import Any

from gym_demohlm.simulation import Simulation, make_pool
from gym_demohlm.task import Task
from gym_demohlm.timing import PHYSICS_DT
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


def _peak_mb() -> float:
    """Return the largest memory that this process has held so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
