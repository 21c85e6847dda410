"""Records of rollouts, facts of a dataset and pictures -> one HTML page that carries everything inside."""

import argparse
import base64
import importlib.resources
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from gym_demohlm.errors import DatasetError
from lerobot_demohlm import drawing
from lerobot_demohlm.datasets.facts import installed_versions, read_facts
from lerobot_demohlm.evaluation.evaluate import read_rollouts, summarize, wilson
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.reports.films import Film, film_strip

SUCCESS_TEXTS = {
    "success_held": "held for 1 s",
    "success_end": "true at the end",
    "success_ever": "true at some step",
}


def starts_plot(rollouts: Sequence[Rollout], size: int = 360) -> Figure:
    """Return where the robot stood at the start of each rollout and where it faced, coloured by success.

    Args:
        rollouts: Of one task and region.
        size: Length of the longer side [px].
    """
    robots = np.array([rollout.initial_state["robot"] for rollout in rollouts], dtype=float)  # (N, 3) x, y [m], yaw
    width, height = drawing.plan_size(robots[:, :2], 0.1, size)
    figure = drawing.new_figure(width + 66, height + 46)
    axes = drawing.new_axes(figure, 52, 8, width, height)
    drawing.equal_scale(axes, robots[:, :2], 0.1)
    axes.set_facecolor(drawing.PAPER)
    drawing.grid(axes)
    axes.set_xlabel("x [m]", fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
    axes.set_ylabel("y [m]", fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
    length = 10 * (axes.get_xlim()[1] - axes.get_xlim()[0]) / width  # [m], of 10 px
    for (x, y, yaw), rollout in zip(robots, rollouts, strict=True):
        colour = drawing.GOOD if rollout.success_held else drawing.BAD
        ahead = (x + length * math.cos(yaw), y + length * math.sin(yaw))
        axes.plot((x, ahead[0]), (y, ahead[1]), color=colour, linewidth=1.0)
        (dot,) = axes.plot(x, y, "o", color=colour, markersize=6)
        drawing.add_tip(dot, f"seed {rollout.seed}: {rollout.outcome.replace('_', ' ')}")
    return figure


def render_report(
    *,
    title: str,
    facts: Mapping[str, Any] | None = None,
    rollouts: Sequence[Rollout] = (),
    films: Sequence[Film] = (),
    video: Path | None = None,
    video_caption: str = "",
    durations: Mapping[str, float] | None = None,
) -> str:
    """Return the page.

    Args:
        title: Heading.
        facts: ``meta/demohlm.json`` of the dataset, if it is to be shown.
        rollouts: Of one policy, if they are to be shown.
        films: Shown as strips.
        video: MP4 to embed.
        video_caption: What it shows.
        durations: Seconds that each step took, by its name.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True)
    template = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / "report.html.j2").read_text()
    seeds = [rollout.seed for rollout in rollouts]
    return environment.from_string(template).render(
        title=title,
        facts=facts,
        generated=wilson(facts["successes"], facts["attempts"]) if facts else None,
        rollouts=summarize(rollouts) if rollouts else None,
        policy=rollouts[0] if rollouts else None,
        seeds=(min(seeds), max(seeds)) if seeds else None,
        starts=drawing.svg(starts_plot(rollouts)) if rollouts else "",
        strips=[{"png": base64.b64encode(film_strip(film)).decode(), "caption": film.caption} for film in films],
        video=base64.b64encode(video.read_bytes()).decode() if video else None,
        video_caption=video_caption,
        durations=durations,
        versions=installed_versions(),
        success_texts=SUCCESS_TEXTS,
        percent=lambda rate: f"{100 * rate:.1f} %",
        outcomes_table=outcomes_table,
    )


def outcomes_table(outcomes: Mapping[str, int], count: int) -> Markup:
    """Return a table of the outcomes that occurred, with bars."""
    rows = [
        Markup(
            '<tr><td>{}</td><td class="number">{}</td><td><span class="bar{}" style="width:{}px"></span></td></tr>'
        ).format(name.replace("_", " "), number, "" if name == "success" else " failed", round(240 * number / count))
        for name, number in outcomes.items()
        if number
    ]
    return Markup("<table><tr><th>Outcome</th><th>Episodes</th><th></th></tr>{}</table>").format(Markup("").join(rows))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm report``."""
    parser.add_argument("--evaluation", type=Path, help="JSON lines of `demohlm evaluate`")
    parser.add_argument("--root", type=Path, help="dataset of `demohlm generate`")
    parser.add_argument("--video", type=Path, help="MP4 to embed")
    parser.add_argument("--results", type=Path, help="folder of JSON lines: report on the experiments instead")
    parser.add_argument("--experiments", type=Path, default=Path("outputs/experiments"), help="--root of reproduce")
    parser.add_argument(
        "--num-videos", type=int, default=0, help="failures of each policy to film (default: %(default)s)"
    )
    parser.add_argument("--num-workers", type=int, default=1, help="processes that film (default: %(default)s)")
    parser.add_argument("--figures", type=Path, help="folder into which the figures of --results go, as SVG")
    parser.add_argument("--output", type=Path, required=True, help="HTML file; must not exist")


def main(arguments: argparse.Namespace) -> None:
    """Write a report of what is given."""
    if arguments.output.exists():
        raise DatasetError(f"the file {arguments.output}, which exists", "a new file", "choose another --output")
    if arguments.results is not None:
        page = _experiments_page(arguments)
    else:
        page = _page(arguments)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(page)
    print(arguments.output)


def _experiments_page(arguments: argparse.Namespace) -> str:
    from lerobot_demohlm.experiments.plan import Layout
    from lerobot_demohlm.reports.experiments_page import render_page, write_figures

    if not arguments.results.is_dir():
        raise DatasetError(f"no folder {arguments.results}", "a folder of JSON lines", "check --results")
    if arguments.figures is not None:
        write_figures(arguments.results, arguments.figures)
    return render_page(
        Layout(root=arguments.experiments, results=arguments.results), arguments.num_videos, arguments.num_workers
    )


def _page(arguments: argparse.Namespace) -> str:
    if arguments.evaluation is None and arguments.root is None:
        raise DatasetError("neither --evaluation nor --root", "one of them or both", "say what to report on")
    if arguments.video is not None and not arguments.video.is_file():
        raise DatasetError(f"no file {arguments.video}", "an MP4", "check --video")
    facts = None if arguments.root is None else read_facts(arguments.root)
    rollouts = [] if arguments.evaluation is None else read_rollouts(arguments.evaluation)
    if rollouts:
        title = f"{rollouts[0].task}, {rollouts[0].region}"
    else:
        title = "" if facts is None else f"{facts['task']}, {facts['region']}"
    return render_report(
        title=title,
        facts=facts,
        rollouts=rollouts,
        video=arguments.video,
        video_caption="" if arguments.video is None else arguments.video.name,
    )
