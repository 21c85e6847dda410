"""``demohlm benchmark simulation``."""

import json
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark simulation``.

    Attributes:
        task: Name of the task.
        num_worlds: Worlds stepped together.
        num_threads: Threads of the physics.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
    """

    task: str = "LiftBox"
    num_worlds: int = 8
    num_threads: int = 1
    controller: str = "default"


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.simulation import measure

    found = measure(get_task(options.task), options.num_worlds, options.num_threads, options.controller)
    print(json.dumps(found))
