"""All benchmarks of simulation, generation and dataset in one run -> one JSON object with the numbers that count."""

import argparse
import json

from datasets import disable_progress_bars

from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import dataset, generation, simulation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark``."""
    parser.add_argument("--task", default="LiftBox", help="name of the task (default: %(default)s)")
    parser.add_argument("--region", default="R3", help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--num-attempts", type=int, default=16, help="of generation (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=2, help="turns of writing (default: %(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Measure; the last line on stdout is the result as JSON, those before it the details."""
    disable_progress_bars()
    task = get_task(arguments.task)
    parts = [
        simulation.measure(task, num_worlds=8, num_threads=1),
        generation.measure(task, arguments.region, 0, arguments.num_attempts),
        dataset.measure_speed(arguments.rounds),
    ]
    for part in parts:
        print(json.dumps(part))
    every = {name: value for part in parts for name, value in part.items()}
    chosen = ("task", "step_efficiency", "mj_step_share", "episodes_per_hour_per_core", "write_speedup")
    print(json.dumps({name: every[name] for name in chosen}))
