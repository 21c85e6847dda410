"""All benchmarks of simulation, generation and dataset in one run -> one JSON object with the numbers that count."""

from typing import Any

from datasets import disable_progress_bars

from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import dataset, generation, simulation


def measure(task: str, region: str, num_attempts: int, rounds: int) -> list[dict[str, Any]]:
    """Return what the benchmarks of simulation, generation and dataset return, in this order.

    Args:
        task: Name of the task.
        region: Initial region.
        num_attempts: Attempts of generation.
        rounds: Turns of writing.
    """
    disable_progress_bars()
    found = get_task(task)
    return [
        simulation.measure(found, num_worlds=8, num_threads=1),
        generation.measure(found, region, 0, num_attempts),
        dataset.measure_speed(rounds),
    ]


def summary(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the numbers that count, of what ``measure`` returned."""
    every = {name: value for part in parts for name, value in part.items()}
    chosen = ("task", "step_efficiency", "mj_step_share", "episodes_per_hour_per_core", "write_speedup")
    return {name: every[name] for name in chosen}
