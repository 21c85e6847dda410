"""``demohlm benchmark variation``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark variation``.

    Attributes:
        tasks: Names of the tasks.
        variations: Names of the variations, such as "real:pushes".
        num_attempts: Attempts in each.
        region: Where attempts start, R1 to R4.
        results: Folder of JSON lines; a line a probe is added to its variation.jsonl, and what is in it is not measured
            again.
    """

    tasks: Annotated[tuple[str, ...], default("all in the package")] = ()
    variations: Annotated[tuple[str, ...], default("none, real, and each group of real")] = ()
    num_attempts: int = 32
    region: str = DEFAULT_REGION
    results: Path = Path("results")


def run(options: Options) -> None:
    """Measure what is missing and print the table in Markdown."""
    from gym_demohlm.registry import all_tasks, get_task
    from lerobot_demohlm.benchmarks.variation import PROBES, measure
    from lerobot_demohlm.experiments.lines import read_measurements
    from lerobot_demohlm.experiments.probe_tables import variation_table

    tasks = [get_task(name) for name in options.tasks or all_tasks()]
    names = [task.name for task in tasks]
    variations = options.variations or PROBES
    path = options.results / "variation.jsonl"
    for line in measure(tasks, variations, options.num_attempts, path, options.region):
        print(f"{line.task} {line.variation}: {line.successes} of {line.attempts} {line.reasons}", flush=True)
    print(variation_table([line for line in read_measurements(path) if line["task"] in names]))
