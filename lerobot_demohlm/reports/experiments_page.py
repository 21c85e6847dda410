"""The lines of ``results/`` and what a run of experiments left -> SVG figures, and a page with tables and failures.

For each policy whose rollouts are at hand the page shows where failures began. Films of failures are made on demand:
each is rolled out again from its seed, several at a time in processes of their own.
"""

import base64
import importlib.resources
import multiprocessing
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure
from tqdm import tqdm

from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm import drawing
from lerobot_demohlm.evaluation.evaluate import read_rollouts
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.experiments import lines, plots, readme_tables
from lerobot_demohlm.experiments.layout import Layout
from lerobot_demohlm.experiments.lines import PolicyResult
from lerobot_demohlm.experiments.plan import Cell
from lerobot_demohlm.experiments.rates import latest, method_title, steps_title
from lerobot_demohlm.experiments.robustness import scored
from lerobot_demohlm.experiments.variants import DEFAULT_VARIANT
from lerobot_demohlm.policies.training import checkpoint
from lerobot_demohlm.reports.films import policy_take, write_take
from lerobot_demohlm.reproducibility.processes import end_with_parent

VIDEO_WIDTH = 320  # px
CAPTIONS = {
    "regions": "Success of generation by initial region, ours and the paper's",
    "robustness": "Strict success of policies against the strength of each group of a variation: one line a task",
    "sizes": "Success of policies by the number of training episodes, ours and the paper's",
    "architectures": "Success by policy, ours and the paper's",
}
"""What stands below a figure, by the beginning of its file's name."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """A film of a failure.

    Attributes:
        mp4: The file, as base64.
        caption: What it shows.
    """

    mp4: str
    caption: str


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A rollout that failed and is to be filmed.

    Attributes:
        cell: Whose rollout it is: it says where robot and objects stood, how worlds differed and how objects were seen.
        seed: Seed of the start.
        outcome: How it ended when it was counted.
        policy: ``pretrained_model`` directory of the policy.
    """

    cell: Cell
    seed: int
    outcome: str
    policy: Path


@dataclass(frozen=True, kw_only=True)
class Section:
    """What the page shows of one policy.

    Attributes:
        title: Task, policy, size and seed.
        result: Its line of results.
        heat_map: SVG of where failures began.
        videos: Films of failures.
    """

    title: str
    result: PolicyResult
    heat_map: str
    videos: Sequence[Video]


def figures(folder: Path) -> dict[str, Figure]:
    """Return the figures that the lines in a folder of results fill, by file name."""
    experiments = lines.read_policies(folder / "experiments.jsonl")
    drawn = {
        "regions.svg": plots.regions_figure(lines.read_generation(folder / "generation.jsonl")),
        "robustness.svg": plots.robustness_figure(scored(experiments)),
    }
    for preset in dict.fromkeys(result.preset for result in experiments):
        drawn[f"sizes_{preset}.svg"] = plots.size_figure(experiments, preset)
        drawn[f"architectures_{preset}.svg"] = plots.architectures_figure(experiments, preset)
    return {name: figure for name, figure in drawn.items() if figure is not None}


def write_figures(folder: Path, target: Path) -> list[Path]:
    """Write the figures of a folder of results into another folder as SVG and return their paths."""
    written = []
    for name, figure in figures(folder).items():
        drawing.save(figure, target / name)
        written.append(target / name)
    return written


def sections(layout: Layout, num_videos: int = 0, num_workers: int = 1) -> list[Section]:
    """Return what is to be shown of each policy whose rollouts are at hand.

    Args:
        layout: Where lines, policies and rollouts are.
        num_videos: Failures of each policy to roll out again and film; none by default.
        num_workers: Processes that film.
    """
    cells, shown, failures = [], [], []
    for result in latest(lines.read_policies(layout.policies_file), any_steps=True):
        cell = Cell(**{name: getattr(result, name) for name in Cell.__dataclass_fields__})
        policy = checkpoint(layout.training(cell))
        if not (cell.is_of(result) and layout.rollouts(cell).is_file() and policy.is_dir()):
            continue
        rollouts = read_rollouts(layout.rollouts(cell))
        chosen = _different([rollout for rollout in rollouts if not rollout.succeeded], num_videos)
        cells.append((cell, result, rollouts, len(chosen)))
        failures += [Failure(cell=cell, seed=one.seed, outcome=one.outcome, policy=policy) for one in chosen]
    videos = film_failures(failures, num_workers)
    for cell, result, rollouts, count in cells:
        own = [next(videos) for _ in range(count)]
        shown.append(
            Section(
                title=_title(cell) + steps_title(result),
                result=result,
                heat_map=drawing.svg(plots.failure_map(rollouts)),
                videos=[video for video in own if video is not None],
            )
        )
    return shown


def _title(cell: Cell) -> str:
    data = "" if cell.variant == DEFAULT_VARIANT else f"{cell.variant}, "
    policy = method_title(cell.policy, cell.preset)
    text = f"{cell.task}: {policy}, {data}{cell.num_train_episodes} episodes, seed {cell.train_seed}"
    if cell.region != DEFAULT_REGION:
        text += f", in {cell.region}"
    if cell.variation != "none":
        text += f", under {cell.variation}"
    return text if cell.perception == "exact" else f"{text}, seen by {cell.perception}"


def _different(failed: Sequence[Rollout], count: int) -> list[Rollout]:
    """Choose failures, one of each outcome before a second of any."""
    by_outcome: dict[str, list[Rollout]] = {}
    for rollout in failed:
        by_outcome.setdefault(rollout.outcome, []).append(rollout)
    ranked = [(place, rollout) for found in by_outcome.values() for place, rollout in enumerate(found)]
    return [rollout for _, rollout in sorted(ranked, key=lambda entry: entry[0])][:count]


def film_failures(failures: Sequence[Failure], num_workers: int = 1) -> Iterator[Video | None]:
    """Roll failures out again and yield their films in order, with a progress bar on stderr.

    Args:
        failures: What to film.
        num_workers: Processes; one films in this process.

    Yields:
        For each failure its film, or None where it ends otherwise now: that of a policy which draws random numbers, or
        acted on a GPU.
    """
    with tqdm(total=len(failures), desc="films", unit="film", disable=not failures) as bar:
        if num_workers == 1 or len(failures) < 2:
            for failure in failures:
                yield _film(failure)
                bar.update()
            return
        # Spawned: this process may have run threads of torch, with which a fork may hang.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            min(num_workers, len(failures)), mp_context=context, initializer=_start_worker
        ) as pool:
            for video in pool.map(_film, failures):
                yield video
                bar.update()


def _start_worker() -> None:
    import torch

    end_with_parent()
    torch.set_num_threads(1)


def _film(failure: Failure) -> Video | None:
    """Roll a failure out again and return its film; None where it ends otherwise now."""
    cell = failure.cell
    task = get_task(cell.task)
    take = policy_take(task, cell.region, failure.seed, failure.policy, cell.variation, cell.perception)
    if take.outcome != failure.outcome:
        return None
    with tempfile.TemporaryDirectory() as scratch:
        write_take(take, Path(scratch), width=VIDEO_WIDTH, strips=False, cameras=("overview",))
        video = (Path(scratch) / f"{task.slug}_overview.mp4").read_bytes()
    return Video(mp4=base64.b64encode(video).decode(), caption=take.caption)


def html_tables(text: str) -> Markup:
    """Turn the Markdown of ``readme_tables.tables`` (headings, titles, tables, ages, commands) into HTML."""
    parts: list[str] = []
    for block in text.split("\n\n"):
        rows = block.splitlines()
        if rows[0].startswith("|"):
            cells = [[escape(cell.strip()) for cell in row.strip("|").split("|")] for row in (rows[0], *rows[2:])]
            tags = ["th", *["td"] * (len(cells) - 1)]
            texts = ["".join(f"<{tag}>{cell}</{tag}>" for cell in row) for tag, row in zip(tags, cells, strict=True)]
            parts.append(f"<table>{''.join(f'<tr>{row}</tr>' for row in texts)}</table>")
        elif rows[0].startswith("## "):
            parts.append(f"<h2>{escape(rows[0].removeprefix('## '))}</h2>")
        elif rows[0].startswith("```"):
            parts.append(f"<pre>{escape(chr(10).join(rows[1:-1]))}</pre>")
        elif rows[0].startswith(("<details>", "</details>")):
            parts.append(block)
        elif rows[0].startswith("**"):
            title, _, rest = block[2:].partition("**")
            parts.append(f"<h3>{escape(title)}</h3><p>{escape(rest.strip(' ,'))}</p>")
        elif rows[0].startswith("*"):
            parts.append(f'<p class="small">{escape(block.strip("*"))}</p>')
        else:
            parts.append(f"<p>{escape(block)}</p>")
    return Markup("".join(parts))


def render_page(layout: Layout, num_videos: int = 0, num_workers: int = 1) -> str:
    """Return the page.

    Args:
        layout: Where lines, policies and rollouts are.
        num_videos: Failures of each policy to roll out again and film; none by default.
        num_workers: Processes that film.
    """
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True)
    template = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / "experiments.html.j2").read_text()
    return environment.from_string(template).render(
        figures=[
            (drawing.svg(figure), CAPTIONS[Path(name).stem.partition("_")[0]])
            for name, figure in figures(layout.results).items()
        ],
        tables=html_tables(readme_tables.tables(layout.results)),
        sections=sections(layout, num_videos, num_workers),
        markup=Markup,
    )
