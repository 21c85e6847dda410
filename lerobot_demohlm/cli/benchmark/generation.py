"""``demohlm benchmark generation``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark generation``.

    Attributes:
        task: Name of the task.
        region: Initial region, R1 to R4.
        seed: Seed of the run.
        num_attempts: Attempts.
        demonstration: Directory of the demonstration.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        variation: How worlds vary. With one other than none, its speed is compared with that of plain worlds.
    """

    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    seed: int = 0
    num_attempts: int = 16
    demonstration: Annotated[Path | None, default("the packaged one")] = None
    controller: str = "default"
    variation: str = "none"


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: The number of attempts is not positive.
    """
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.generation import compare, measure

    if options.num_attempts < 1:
        raise DatasetError(f"num_attempts={options.num_attempts}", "1 or more", "correct --num-attempts")
    asked = (get_task(options.task), options.region, options.seed, options.num_attempts)
    given = {"demonstration": options.demonstration, "controller": options.controller}
    found = measure(*asked, **given) if options.variation == "none" else compare(*asked, options.variation, **given)
    print(json.dumps(found))
