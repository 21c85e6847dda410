"""The lines of ``results/`` and what a run of experiments left -> SVG figures, and a page with tables and failures.

For each policy whose rollouts are at hand the page shows where failures began, and videos of some, rolled out again
from their seeds.
"""

import base64
import importlib.resources
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from gym_demohlm.registry import get_task
from lerobot_demohlm.evaluation.evaluate import read_records
from lerobot_demohlm.experiments import lines, plots, readme_tables
from lerobot_demohlm.experiments.plan import DEFAULT_VARIANT, Cell, Layout
from lerobot_demohlm.experiments.tables import latest, method_title
from lerobot_demohlm.policies.training import checkpoint

VIDEO_WIDTH = 320  # px
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Section:
    """What the page shows of one policy.

    Attributes:
        title: Task, policy, size and seed.
        line: Its line of results.
        heat_map: SVG of where failures began.
        videos: (MP4 as base64, caption) of failures.
    """

    title: str
    line: Line
    heat_map: str
    videos: Sequence[tuple[str, str]]


def figures(folder: Path) -> dict[str, str]:
    """Return the figures that the lines in a folder of results fill, as SVG by file name."""
    experiments = lines.read(folder / "experiments.jsonl")
    drawn = {"regions.svg": plots.regions_figure(lines.read(folder / "generation.jsonl"))}
    for preset in dict.fromkeys(line["preset"] for line in experiments):
        drawn[f"sizes_{preset}.svg"] = plots.size_figure(experiments, preset)
        drawn[f"architectures_{preset}.svg"] = plots.architectures_figure(experiments, preset)
    return {name: svg for name, svg in drawn.items() if svg}


def write_figures(folder: Path, target: Path) -> list[Path]:
    """Write the figures of a folder of results into another and return their paths."""
    target.mkdir(parents=True, exist_ok=True)
    written = []
    for name, svg in figures(folder).items():
        (target / name).write_text(svg)
        written.append(target / name)
    return written


def sections(layout: Layout, num_videos: int = 0) -> list[Section]:
    """Return what is to be shown of each policy whose rollouts are at hand.

    Args:
        layout: Where lines, policies and rollouts are.
        num_videos: Failures of each that are rolled out again and filmed.
    """
    shown = []
    for line in latest(lines.read(layout.policies_file)):
        cell = Cell(**{name: line[name] for name in Cell.__dataclass_fields__})
        if not (cell.is_of(line) and layout.rollouts(cell).is_file() and checkpoint(layout.training(cell)).is_dir()):
            continue
        records = read_records(layout.rollouts(cell))
        failed = [record for record in records if not record["success_held"]]
        shown.append(
            Section(
                title=_title(cell),
                line=line,
                heat_map=plots.failure_map(records),
                videos=[film for record in _different(failed, num_videos) for film in _films(cell, layout, record)],
            )
        )
    return shown


def _title(cell: Cell) -> str:
    data = "" if cell.variant == DEFAULT_VARIANT else f"{cell.variant}, "
    policy = method_title(cell.policy, cell.preset)
    return f"{cell.task}: {policy}, {data}{cell.num_train_episodes} episodes, seed {cell.train_seed}"


def _different(failed: Sequence[Mapping[str, Any]], count: int) -> list[Mapping[str, Any]]:
    """Choose failures, one of each outcome before a second of any."""
    by_outcome: dict[str, list[Mapping[str, Any]]] = {}
    for record in failed:
        by_outcome.setdefault(record["outcome"], []).append(record)
    ranked = [(place, record) for found in by_outcome.values() for place, record in enumerate(found)]
    return [record for _, record in sorted(ranked, key=lambda entry: entry[0])][:count]


def _films(cell: Cell, layout: Layout, record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Roll a failure out again and return its video as base64, and its caption.

    None where it ends otherwise now: that of a policy which draws random numbers, or acted on a GPU.
    """
    from lerobot_demohlm.reports.gallery import policy_take, write_take

    task = get_task(cell.task)
    take = policy_take(task, cell.region, record["seed"], checkpoint(layout.training(cell)))
    if take.outcome != record["outcome"]:
        return []
    with tempfile.TemporaryDirectory() as scratch:
        write_take(take, Path(scratch), width=VIDEO_WIDTH)
        video = (Path(scratch) / f"{task.slug}_overview.mp4").read_bytes()
    return [(base64.b64encode(video).decode(), take.caption)]


def html_tables(text: str) -> Markup:
    """Turn the Markdown of ``readme_tables.tables`` (titles, tables, blocks of commands) into HTML."""
    parts: list[str] = []
    for block in text.split("\n\n"):
        lines = block.splitlines()
        if lines[0].startswith("|"):
            rows = [[escape(cell.strip()) for cell in row.strip("|").split("|")] for row in (lines[0], *lines[2:])]
            tags = ["th", *["td"] * (len(rows) - 1)]
            cells = ["".join(f"<{tag}>{cell}</{tag}>" for cell in row) for tag, row in zip(tags, rows, strict=True)]
            parts.append(f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>")
        elif lines[0].startswith("```"):
            parts.append(f"<pre>{escape(chr(10).join(lines[1:-1]))}</pre>")
        elif lines[0].startswith("**"):
            title, _, rest = block[2:].partition("**")
            parts.append(f"<h2>{escape(title)}</h2><p>{escape(rest.strip(' ,'))}</p>")
        else:
            parts.append(f"<p>{escape(block)}</p>")
    return Markup("".join(parts))


def render_page(layout: Layout, num_videos: int = 0) -> str:
    """Return the page.

    Args:
        layout: Where lines, policies and rollouts are.
        num_videos: Failures of each policy that are rolled out again and filmed.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True)
    template = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / "experiments.html.j2").read_text()
    return environment.from_string(template).render(
        figures=[Markup(svg) for svg in figures(layout.results).values()],
        tables=html_tables(readme_tables.tables(layout.results)),
        sections=sections(layout, num_videos),
        markup=Markup,
    )
