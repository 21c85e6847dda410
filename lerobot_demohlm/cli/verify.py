"""``demohlm verify``."""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm verify``.

    Attributes:
        root: Dataset of `demohlm generate`, or its failures.
        task: Where a task from outside the package is defined, as my_module:MyTask.
        episodes: Which episodes: all, or numbers such as 0,5,17.
        sample: Verify this many of those episodes, drawn at random.
        seed: Seed of that draw.
        num_workers: Processes.
        demonstration: Directory of the demonstration, for datasets that LeRobot's tools have edited.
        controller: Name, path or hash of the controller to simulate with.
    """

    root: Path
    task: Annotated[str | None, default("the dataset's task")] = None
    episodes: str = "all"
    sample: Annotated[int | None, default("all of them")] = None
    seed: int = 0
    num_workers: int = 1
    demonstration: Annotated[Path | None, default("the packaged one")] = None
    controller: Annotated[str | None, default("the one that the dataset names")] = None


def run(options: Options) -> int:
    """Verify a dataset; exit code 1 where an episode does not agree. The last line on stdout is a JSON object."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.checks.verify import SHOWN, choose, verify
    from lerobot_demohlm.datasets import origin, reader

    root = options.root
    task = get_task(options.task or origin.task_of(root))
    began = time.monotonic()
    chosen = choose(options.episodes, options.sample, len(reader.lengths(root)), options.seed)
    outcome = verify(
        root,
        task,
        chosen,
        options.num_workers,
        on_mismatches=_say,
        show_progress=True,
        demonstration=options.demonstration,
        controller=options.controller,
    )
    print("\n".join(outcome.lines()))
    content = asdict(outcome) | {"identical": outcome.identical, "episodes_that_differ": len(outcome.differences)}
    content["episodes_within_bounds"] = outcome.within_bounds
    content["differences"] = content["differences"][:SHOWN]
    content["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(content))
    return 0 if outcome.agrees else 1


def _say(different: tuple[str, ...]) -> None:
    for line in different:
        print(line, flush=True)
    if different:
        print("bits hold for one version of the code and its libraries: this alone may change them", flush=True)
