"""``demohlm benchmark tracking``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark tracking``.

    Attributes:
        tasks: Names of the tasks.
        num_episodes: Generated episodes of each that are looked at.
        region: Where episodes start, R1 to R4.
        seed: Of the episodes, and of the eyes.
        results: Folder of JSON lines; a line for each tracked object is added to its tracking.jsonl.
    """

    tasks: Annotated[tuple[str, ...], default("all in the package")] = ()
    num_episodes: int = 2
    region: str = DEFAULT_REGION
    seed: int = 21
    results: Path = Path("results")


def run(options: Options) -> None:
    """Measure, and print the table in Markdown.

    Raises:
        DatasetError: ``num_episodes`` is less than 1.
        UnknownNameError: No such task or region.
        SceneError: This machine has nothing to draw with.
    """
    from gym_demohlm.errors import DatasetError
    from gym_demohlm.registry import all_tasks, get_task
    from lerobot_demohlm.benchmarks.tracking import measure
    from lerobot_demohlm.experiments.lines import read_measurements
    from lerobot_demohlm.experiments.perception_tables import tracking_table
    from lerobot_demohlm.reproducibility.results import append_result

    if options.num_episodes < 1:
        raise DatasetError(f"num_episodes={options.num_episodes}", "1 or more", "correct --num-episodes")
    tasks = [get_task(name) for name in options.tasks or tuple(all_tasks())]
    path = options.results / "tracking.jsonl"
    for task in tasks:
        call = f"demohlm benchmark tracking --tasks {task.name} --num-episodes {options.num_episodes}"
        for line in measure(task, options.region, options.seed, range(options.num_episodes)):
            append_result(path, f"{call} --region {options.region} --seed {options.seed}", line)
    names = [task.name for task in tasks]
    print(tracking_table([line for line in read_measurements(path) if line["task"] in names]))
