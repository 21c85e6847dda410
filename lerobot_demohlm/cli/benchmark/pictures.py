"""``demohlm benchmark pictures``."""

import json
from dataclasses import dataclass
from typing import Annotated

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark pictures``.

    Attributes:
        task: Name of the task.
        region: Initial region, R1 to R4.
        seed: Seed of the run.
        num_attempts: Attempts.
        cameras: What is drawn of each, as in generate.
    """

    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    seed: int = 0
    num_attempts: int = 16
    cameras: Annotated[tuple[str, ...] | None, default("96 x 96 pixels of the head, colour and depth")] = None


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: The number of attempts is not positive, or no camera is named.
    """
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.pictures import measure

    cameras = ("head:96x96:rgb,depth",) if options.cameras is None else options.cameras
    if options.num_attempts < 1 or not cameras:
        raise DatasetError(
            f"num_attempts={options.num_attempts} and {len(cameras)} cameras",
            "1 or more of both",
            "correct --num-attempts or --cameras",
        )
    task = get_task(options.task)
    print(json.dumps(measure(task, options.region, options.seed, options.num_attempts, cameras)))
