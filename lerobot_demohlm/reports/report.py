"""Records of rollouts, facts of a dataset and pictures -> one HTML page that carries everything inside."""

import argparse
import base64
import importlib.resources
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.facts import installed_versions, read_facts
from lerobot_demohlm.evaluation.evaluate import read_records, summarize, wilson

SUCCESS_TEXTS = {
    "success_held": "held for 1 s",
    "success_end": "true at the end",
    "success_ever": "true at some step",
}


@dataclass(frozen=True, kw_only=True)
class Film:
    """Pictures of one episode.

    Attributes:
        frames: (T, height, width, 3) uint8.
        caption: What it shows.
        fps: Frames a second of simulated time.
    """

    frames: Sequence[np.ndarray]
    caption: str
    fps: int = 10


def film_strip(film: Film, count: int = 8, width: int = 240) -> bytes:
    """Return a PNG of frames from the first to the last, two rows, each with its time.

    Args:
        film: What to show.
        count: Frames shown, at most; even numbers fill the rows.
        width: Of a frame [px].
    """
    from PIL import Image, ImageDraw

    chosen = np.unique(np.linspace(0, len(film.frames) - 1, count).round().astype(int))
    height = round(width * film.frames[0].shape[0] / film.frames[0].shape[1])
    columns = math.ceil(len(chosen) / 2)
    strip = Image.new("RGB", (columns * width, math.ceil(len(chosen) / columns) * height), "white")
    for place, index in enumerate(chosen):
        picture = Image.fromarray(film.frames[index]).resize((width, height), Image.Resampling.LANCZOS)
        ImageDraw.Draw(picture).text(
            (6, 4), f"{index / film.fps:.1f} s", fill="white", stroke_width=1, stroke_fill="black"
        )
        strip.paste(picture, (place % columns * width, place // columns * height))
    stream = io.BytesIO()
    strip.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def write_video(path: Path, film: Film) -> None:
    """Write a film as MP4."""
    from lerobot.utils.io_utils import write_video as write

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, list(film.frames), film.fps)


def starts_plot(records: Sequence[Mapping[str, Any]], size: int = 360) -> str:
    """Return an SVG of where the robot stood at the start of each rollout, coloured by success.

    Args:
        records: Of ``evaluation.rollouts``.
        size: Width [px].
    """
    robots = np.array(
        [record["initial_state"]["robot"] for record in records], dtype=float
    )  # (N, 3) x, y [m], yaw [rad]
    low, high = robots[:, :2].min(axis=0) - 0.1, robots[:, :2].max(axis=0) + 0.1
    scale = size / (high - low).max()
    shapes = []
    for (x, y, yaw), record in zip(robots, records, strict=True):
        u, v = (x - low[0]) * scale, (high[1] - y) * scale
        du, dv = 10 * math.cos(yaw), -10 * math.sin(yaw)
        colour = "#2f6f4f" if record["success_held"] else "#b5482f"
        shapes.append(
            f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3.5" fill="{colour}"/>'
            f'<line x1="{u:.1f}" y1="{v:.1f}" x2="{u + du:.1f}" y2="{v + dv:.1f}" stroke="{colour}"/>'
        )
    width, height = (high - low) * scale
    box = f'<rect width="{width:.0f}" height="{height:.0f}" fill="#f6f8fa" stroke="#c8ced6"/>'
    label = (
        f'<text x="4" y="{height + 14:.0f}" font-size="12">x {low[0]:.2f} to {high[0]:.2f} m, '
        f"y {low[1]:.2f} to {high[1]:.2f} m</text>"
    )
    size_text = f'width="{width:.0f}" height="{height + 18:.0f}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size_text}>{box}{"".join(shapes)}{label}</svg>'


def render_report(
    *,
    title: str,
    facts: Mapping[str, Any] | None = None,
    records: Sequence[Mapping[str, Any]] = (),
    films: Sequence[Film] = (),
    video: Path | None = None,
    video_caption: str = "",
    durations: Mapping[str, float] | None = None,
) -> str:
    """Return the page.

    Args:
        title: Heading.
        facts: ``meta/demohlm.json`` of the dataset, if it is to be shown.
        records: Rollouts of one policy, if they are to be shown.
        films: Shown as strips.
        video: MP4 to embed.
        video_caption: What it shows.
        durations: Seconds that each step took, by its name.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True)
    template = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / "report.html.j2").read_text()
    seeds = [record["seed"] for record in records]
    return environment.from_string(template).render(
        title=title,
        facts=facts,
        generated=wilson(facts["successes"], facts["attempts"]) if facts else None,
        rollouts=summarize([dict(record) for record in records]) if records else None,
        policy=records[0] if records else None,
        seeds=(min(seeds), max(seeds)) if seeds else None,
        starts=Markup(starts_plot(records)) if records else "",
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
    from lerobot_demohlm.experiments.page import render_page, write_figures
    from lerobot_demohlm.experiments.plan import Layout

    if not arguments.results.is_dir():
        raise DatasetError(f"no folder {arguments.results}", "a folder of JSON lines", "check --results")
    if arguments.figures is not None:
        write_figures(arguments.results, arguments.figures)
    return render_page(Layout(root=arguments.experiments, results=arguments.results), arguments.num_videos)


def _page(arguments: argparse.Namespace) -> str:
    if arguments.evaluation is None and arguments.root is None:
        raise DatasetError("neither --evaluation nor --root", "one of them or both", "say what to report on")
    if arguments.video is not None and not arguments.video.is_file():
        raise DatasetError(f"no file {arguments.video}", "an MP4", "check --video")
    facts = None if arguments.root is None else read_facts(arguments.root)
    records = [] if arguments.evaluation is None else read_records(arguments.evaluation)
    shown = records[0] if records else facts or {}
    return render_report(
        title=f"{shown['task']}, {shown['region']}",
        facts=facts,
        records=records,
        video=arguments.video,
        video_caption="" if arguments.video is None else arguments.video.name,
    )
