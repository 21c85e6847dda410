"""``demohlm benchmark teleoperation``."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark teleoperation``.

    Attributes:
        task: Name of the task.
        seconds: How long to measure [s].
        browser: Have Chromium emulate the headset and show the spectator's view; needs playwright and --iwer.
        iwer: Path of iwer.min.js of the npm package iwer 2.5.0.
        append: Append the result to this file of JSON lines.
    """

    task: str = "LiftBox"
    seconds: float = 60.0
    browser: bool = False
    iwer: Annotated[Path | None, default("$DEMOHLM_IWER")] = None
    append: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.teleoperation import measure
    from lerobot_demohlm.reproducibility.results import append_result

    given = os.environ.get("DEMOHLM_IWER")
    iwer = options.iwer or (Path(given) if given else None)
    result = measure(get_task(options.task), options.seconds, options.browser, iwer)
    if options.append is not None:
        call = f"demohlm benchmark teleoperation --task {options.task} --seconds {options.seconds:g}"
        result = append_result(options.append, call + (" --browser" if options.browser else ""), result)
    print_json(result)
