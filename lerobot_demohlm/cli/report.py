"""``demohlm report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm report``.

    Attributes:
        evaluation: JSON lines of `demohlm evaluate`.
        root: Dataset of `demohlm generate`.
        video: MP4 file to embed.
        results: Folder of JSON lines; the report is on the experiments then.
        experiments: The --root of `demohlm reproduce`, for a report on the experiments.
        num_videos: Failures of each policy to film, in a report on the experiments.
        num_workers: Processes that film.
        figures: Folder into which the figures of a report on the experiments go, too, as SVG.
        output: HTML file; must not exist.
    """

    evaluation: Annotated[Path | None, default("none")] = None
    root: Annotated[Path | None, default("none")] = None
    video: Annotated[Path | None, default("none")] = None
    results: Annotated[Path | None, default("none")] = None
    experiments: Path = Path("outputs/experiments")
    num_videos: int = 0
    num_workers: int = 1
    figures: Annotated[Path | None, default("none")] = None
    output: Path


def run(options: Options) -> None:
    """Write a report of what is given."""
    if options.output.exists():
        raise DatasetError(f"the file {options.output}, which exists", "a new file", "choose another --output")
    if options.num_videos < 0 or options.num_workers < 1:
        got = f"num_videos={options.num_videos}, num_workers={options.num_workers}"
        raise DatasetError(got, "0 or more videos and 1 or more workers", "correct them")
    of_results = options.results is not None
    other = ("evaluation", "root", "video") if of_results else ("figures", "num_videos")
    ignored = " and ".join(f"--{name.replace('_', '-')}" for name in other if getattr(options, name))
    if ignored:
        got = f"{ignored} {'with' if of_results else 'without'} --results"
        raise DatasetError(got, "a report of results, or one of rollouts and a dataset", "leave some options out")
    page = _page(options) if options.results is None else _experiments_page(options, options.results)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(page)
    print(options.output)


def _experiments_page(options: Options, results: Path) -> str:
    from lerobot_demohlm.experiments.layout import Layout
    from lerobot_demohlm.reports.experiments_page import render_page, write_figures

    if not results.is_dir():
        raise DatasetError(f"no folder {results}", "a folder of JSON lines", "check --results")
    if options.figures is not None:
        write_figures(results, options.figures)
    return render_page(Layout(root=options.experiments, results=results), options.num_videos, options.num_workers)


def _page(options: Options) -> str:
    from lerobot_demohlm.datasets.facts import read_facts
    from lerobot_demohlm.evaluation.evaluate import read_rollouts
    from lerobot_demohlm.reports.report import render_report

    if options.evaluation is None and options.root is None:
        raise DatasetError("neither --evaluation nor --root", "one of them or both", "say what to report on")
    if options.video is not None and not options.video.is_file():
        raise DatasetError(f"no file {options.video}", "an MP4", "check --video")
    facts = None if options.root is None else read_facts(options.root)
    rollouts = [] if options.evaluation is None else read_rollouts(options.evaluation)
    tasks = {rollout.task for rollout in rollouts} | ({facts["task"]} if facts is not None else set())
    if len(tasks) > 1:
        got = f"a dataset and rollouts of {' and '.join(sorted(tasks))}"
        raise DatasetError(got, "of one task", "check --root and --evaluation")
    if rollouts:
        title = f"{rollouts[0].task}, {rollouts[0].region}"
    else:
        title = "" if facts is None else f"{facts['task']}, {facts['region']}"
    return render_report(
        title=title,
        facts=facts,
        rollouts=rollouts,
        video=options.video,
        video_caption="" if options.video is None else options.video.name,
    )
