"""Records of rollouts, facts of a dataset and pictures -> one HTML page that carries everything inside."""

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

from lerobot_demohlm import drawing
from lerobot_demohlm.datasets.facts import installed_versions
from lerobot_demohlm.evaluation.evaluate import summarize, wilson
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.reports.films import Film, film_strip
from lerobot_demohlm.reports.influences import influences, section

SUCCESS_TEXTS = {
    "success_strict": "held, nothing went wrong before, and the robot stood for 2 s after it",
    "success_held": "held for 1 s",
    "success_end": "true at the end",
    "success_ever": "true at some step",
}


def starts_plot(rollouts: Sequence[Rollout], success: np.ndarray, size: int = 360) -> Figure:
    """Return where the robot stood at the start of each rollout and where it faced, coloured by success.

    Args:
        rollouts: Of one task and region.
        success: (N,) bool.
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
    for (x, y, yaw), rollout, succeeded in zip(robots, rollouts, success, strict=True):
        colour = drawing.GOOD if succeeded else drawing.BAD
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
    summary = summarize(rollouts) if rollouts else {}
    judged = next((name for name in SUCCESS_TEXTS if name in summary), "")  # older rollouts were not judged strictly
    success = np.array([getattr(rollout, judged) for rollout in rollouts], dtype=bool)
    found = influences([rollout.initial_state for rollout in rollouts], success)
    return environment.from_string(template).render(
        title=title,
        facts=facts,
        generated=wilson(facts["successes"], facts["attempts"]) if facts else None,
        rollouts=summary,
        headline=summary.get(judged),
        policy=rollouts[0] if rollouts else None,
        seeds=(min(seeds), max(seeds)) if seeds else None,
        starts=drawing.svg(starts_plot(rollouts, success)) if rollouts else "",
        influences=section(found),
        strips=[{"png": base64.b64encode(film_strip(film)).decode(), "caption": film.caption} for film in films],
        video=base64.b64encode(video.read_bytes()).decode() if video else None,
        video_caption=video_caption,
        durations=durations,
        versions=installed_versions(),
        success_texts=SUCCESS_TEXTS,
        percent=lambda rate: f"{100 * rate:.1f} %",
        outcomes_table=outcomes_table,
        worlds=worlds,
    )


def worlds(variation: str, perception: str) -> str:
    """Return in which worlds something was done, and with which eyes: nothing in plain worlds with exact ones."""
    varied = "" if variation == "none" else f", in worlds that vary by {variation}"
    return varied + ("" if perception == "exact" else f", objects seen by {perception}")


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
