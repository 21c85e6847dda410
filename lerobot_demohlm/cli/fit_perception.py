"""``demohlm fit-perception``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default, spelled
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm fit-perception``.

    Attributes:
        task: Name of the task, such as LiftBox.
        region: Initial region.
        seed: Seed of the generated episodes.
        num_episodes: Episodes that the model is fitted to.
        num_checks: Further episodes that it is compared with.
        output: File of the fitted model.
        results: File to which the comparison's lines are appended.
    """

    task: str
    region: str = DEFAULT_REGION
    seed: int = 31
    num_episodes: int = 10
    num_checks: int = 5
    output: Annotated[Path | None, default("the package's file of the task")] = None
    results: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Fit; the last line on stdout is the comparison as JSON."""
    from gym_demohlm.errors import SceneError
    from gym_demohlm.perception.error_model import fitted_path
    from lerobot_demohlm.benchmarks.perception_fit import fit
    from lerobot_demohlm.reproducibility.results import append_result

    if options.num_episodes < 1 or options.num_checks < 0:
        raise SceneError(
            f"num_episodes={options.num_episodes}, num_checks={options.num_checks}", "1 and 0 or more", "correct them"
        )
    task = get_task(options.task)
    model, lines = fit(task, options.region, options.seed, options.num_episodes, options.num_checks)
    path = options.output or fitted_path(task)
    model.write(path)
    if options.results is not None:
        for line in lines:
            append_result(options.results, spelled("fit-perception", options), line)
    print_json({"task": task.name, "output": str(path), "fit": model.hash, "fresh": lines})
