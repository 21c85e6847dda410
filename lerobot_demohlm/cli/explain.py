"""``demohlm explain``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from lerobot_demohlm.cli.parsing import default

_ONE = tyro.conf.create_mutex_group(required=False, title="which attempt")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm explain``.

    Attributes:
        root: Dataset of `demohlm generate`, or ROOT.partial while it is being made; or record of `demohlm deploy`.
        attempt: Explain this attempt, failed or not.
        episode: Explain the attempt that is this episode of the dataset.
        output: HTML file; must not exist.
        task: Where a task from outside the package is defined, as my_module:MyTask.
        demonstration: Directory of the demonstration.
        no_pictures: Leave the film strips out.
    """

    root: Path
    attempt: Annotated[int | None, _ONE, default("the whole run")] = None
    episode: Annotated[int | None, _ONE, default("the whole run")] = None
    output: Path
    task: Annotated[str | None, default("the dataset's task")] = None
    demonstration: Annotated[Path | None, default("the packaged one")] = None
    no_pictures: bool = False


def run(options: Options) -> None:
    """Write the page; the last line on stdout is a JSON object."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.datasets import reader
    from lerobot_demohlm.reports.explain import explain_attempt, explain_run, pages, read_run
    from lerobot_demohlm.reports.explain.deployment_page import explain_deployment, is_deployment

    pages.require_new(options.output)
    task = None if options.task is None else get_task(options.task)
    short: dict[str, Any]
    attempt = options.attempt
    if is_deployment(options.root):
        page, short = explain_deployment(options.root)
        pages.write(options.output, page)
        print(json.dumps({"page": str(options.output), **short}))
        return
    if options.episode is not None:
        attempt = reader.attempt_of(options.root, options.episode)
    if attempt is None:
        page = explain_run(options.root, task)
        facts, _ = read_run(options.root)
        short = {key: facts[key] for key in ("attempts", "successes", "outcomes")}
    else:
        page, short = explain_attempt(
            options.root, attempt, task, options.demonstration, not options.no_pictures, options.episode
        )
        print(f"{short['outcome']} in {short['stage']} after {short['length_s']:.1f} s. {short['reason']}".strip())
    pages.write(options.output, page)
    print(json.dumps({"page": str(options.output), **short}))
