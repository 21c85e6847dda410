"""``demohlm lint-task``."""

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm.checks.lint import Settings, format_table, lint
from lerobot_demohlm.cli.parsing import default, only, spelled
from lerobot_demohlm.demonstrations.demonstration import load

ALL = "all"


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Options of ``demohlm lint-task``.

    Attributes:
        task: Name of the task, such as LiftBox, or "all".
        root: Directory of the demonstration.
        no_demonstration: Leave out what needs a demonstration.
        results: Folder of JSON lines; a line a task is added to its lint.jsonl.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    root: Annotated[Path | None, default("the packaged one")] = None
    no_demonstration: bool = False
    time_limit_s: Annotated[float | None, default("the task's own")] = None
    results: Annotated[Path | None, default("none")] = None


def run(options: Options) -> int:
    """Print a table a task, then one line of JSON with the number of each check; exit code 1 where a check failed."""
    settings = only(Settings, options)
    everything = options.task == ALL
    if everything and options.root is not None:
        raise DemoHLMError(f"--root with {ALL!r}", "one task", "name the task of that demonstration")
    failed: dict[str, list[str]] = {}
    found: dict[str, dict[str, float]] = {}
    for task in all_tasks().values() if everything else [get_task(options.task)]:
        demonstration = None if options.no_demonstration else load(options.root, task)
        began = time.process_time()
        checks = lint(task, demonstration, settings)
        failed[task.name] = [check.name for check in checks if not check.ok]
        found[task.name] = {check.name: check.number for check in checks}
        found[task.name]["CPU time"] = round(time.process_time() - began, 1)
        print(format_table(task.name, checks), end="\n\n", flush=True)
        if options.results is not None:
            from lerobot_demohlm.checks import portability
            from lerobot_demohlm.reproducibility.results import append_result

            line = {"task": task.name, **asdict(settings), "failed": failed[task.name], "found": found[task.name]}
            line["stamp"] = portability.stamp(task)
            call = spelled("lint-task", replace(options, task=task.name), ("root", "no_demonstration", "results"))
            append_result(options.results / "lint.jsonl", call, line)
    ok = not any(failed.values())
    print(json.dumps({"ok": ok, "failed": failed, "found": found, **asdict(settings)}))
    return 0 if ok else 1
