"""``demohlm benchmark feedback``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark feedback``.

    Attributes:
        tasks: Names of the tasks.
        variations: Names of the variations.
        replays: Ways to replay, such as "ours" or "open, no symmetry".
        num_attempts: Attempts in each.
        region: Where attempts start, R1 to R4.
        results: Folder of JSON lines; a line for each is added to its feedback.jsonl, and what is in it is not measured
            again.
    """

    tasks: tuple[str, ...] = ("LiftBox", "GraspCube", "PushCube")
    variations: tuple[str, ...] = ("none", "real")
    replays: Annotated[tuple[str, ...], default("all")] = ()
    num_attempts: int = 32
    region: str = DEFAULT_REGION
    results: Path = Path("results")


def run(options: Options) -> None:
    """Measure what is missing and print the tables in Markdown."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.feedback import REPLAYS, measure
    from lerobot_demohlm.experiments.lines import read_measurements
    from lerobot_demohlm.experiments.probe_tables import feedback_table

    tasks = [get_task(name) for name in options.tasks]
    names = [task.name for task in tasks]
    replays, path = options.replays or tuple(REPLAYS), options.results / "feedback.jsonl"
    for line in measure(tasks, options.variations, replays, options.num_attempts, path, options.region):
        found = f"{line.strict} of {line.attempts} {line.reasons}"
        print(f"{line.task} {line.variation} {line.replay}: {found}", flush=True)
    print(feedback_table([line for line in read_measurements(path) if line["task"] in names]))
