"""``demohlm benchmark``; the files beside this one own ``demohlm benchmark PART``."""

import json
from dataclasses import dataclass

from gym_demohlm.task import DEFAULT_REGION


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark``.

    Attributes:
        task: Name of the task.
        region: Initial region, R1 to R4.
        num_attempts: Attempts of generation.
        rounds: Turns of writing.
    """

    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    num_attempts: int = 16
    rounds: int = 2


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON, those before it the details."""
    from lerobot_demohlm.benchmarks.suite import measure, summary

    parts = measure(options.task, options.region, options.num_attempts, options.rounds)
    for part in parts:
        print(json.dumps(part))
    print(json.dumps(summary(parts)))
