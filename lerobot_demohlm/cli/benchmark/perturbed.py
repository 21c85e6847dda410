"""``demohlm benchmark perturbed``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark perturbed``.

    Attributes:
        tasks: Names of the tasks.
        first: Seed of the first operator.
        num_operators: Operators, each with a demonstration of each task.
        num_attempts: Attempts from each demonstration.
        num_trial: Attempts of the trial that operators look at before they save; 0 for none.
        region: Where attempts start, R1 to R4.
        append: File of JSON lines with the results; what is in it is not measured again.
        root: Folder for the demonstrations.
    """

    tasks: Annotated[tuple[str, ...], default("all in the package")] = ()
    first: int = 0
    num_operators: int = 20
    num_attempts: int = 20
    num_trial: int = 20
    region: str = DEFAULT_REGION
    append: Path = Path("results/perturbed.jsonl")
    root: Path = Path("outputs/perturbed")


def run(options: Options) -> None:
    """Measure what is missing and print the table in Markdown."""
    from gym_demohlm.registry import all_tasks, get_task
    from lerobot_demohlm.benchmarks.perturbed import measure, table
    from lerobot_demohlm.reproducibility.processes import hush_torchcodec

    hush_torchcodec()

    tasks = [get_task(name) for name in options.tasks or all_tasks()]
    operators = range(options.first, options.first + options.num_operators)
    lines = []
    for line in measure(
        tasks,
        operators,
        options.num_attempts,
        options.append,
        options.root,
        options.region,
        options.num_trial,
    ):
        found = f"{line.successes} of {line.attempts} attempts, {line.tries} recordings"
        print(f"{line.task} {line.operator}: {line.refusal or found}", flush=True)
        lines.append(line)
    print(table(lines, [task.name for task in tasks]))
