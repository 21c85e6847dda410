"""Lines of results -> the paper's figures as SVG: success by data size, by policy and by region; failures by start."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.experiments import paper
from lerobot_demohlm.experiments.plan import DEFAULT_VARIANT, REGIONS
from lerobot_demohlm.experiments.tables import TITLES, age, by_region, group, latest, mean_rate, rate
from lerobot_demohlm.policies.presets import POLICIES

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 260, 170, 34, 16, 24, 26  # of one panel and of its margins [px]
COLOURS = {"mlp": "#2f6f4f", "act": "#2b5f9e", "diffusion": "#8a5aa8", "paper": "#9aa2ab", "generation": "#2f6f4f"}
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a panel.

    Attributes:
        name: What it is; a key of COLOURS.
        points: (place on the horizontal axis in [0, 1], rate, low, high), rates in [0, 1].
    """

    name: str
    points: Sequence[tuple[float, float, float, float]]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One small plot, its vertical axis a rate from 0 to 100 %.

    Attributes:
        title: Above it.
        ticks: (place in [0, 1], text) along the horizontal axis.
        curves: What it shows.
        bars: Whether points are bars from below rather than joined by lines.
    """

    title: str
    ticks: Sequence[tuple[float, str]]
    curves: Sequence[Curve] = field(default_factory=tuple)
    bars: bool = False

    def svg(self) -> str:
        """Return the panel as SVG elements with the origin at its upper left corner."""
        across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

        def place(x: float, y: float) -> tuple[float, float]:
            return LEFT + x * across, TOP + (1 - y) * down

        parts = [f'<text x="{LEFT}" y="14" font-weight="600">{escape(self.title)}</text>']
        for share in (0.0, 0.5, 1.0):
            x, y = place(0, share)
            parts.append(f'<line x1="{x}" y1="{y}" x2="{x + across}" y2="{y}" stroke="#e1e5ea"/>')
            parts.append(f'<text x="{x - 4}" y="{y + 4}" text-anchor="end">{100 * share:.0f}</text>')
        for where, text in self.ticks:
            x, y = place(where, 0)
            parts.append(f'<text x="{x:.1f}" y="{y + 15}" text-anchor="middle">{escape(text)}</text>')
        for curve in self.curves:
            parts += self._curve(curve, place)
        return "".join(parts)

    def _curve(self, curve: Curve, place: Callable[[float, float], tuple[float, float]]) -> list[str]:
        colour, parts = COLOURS[curve.name], []
        corners = []
        for x, mean, low, high in curve.points:
            u, v = place(x, mean)
            (_, top), (_, bottom) = place(x, high), place(x, low)
            corners.append(f"{u:.1f},{v:.1f}")
            if self.bars:
                floor = place(x, 0)[1]
                parts.append(f'<rect x="{u - 8:.1f}" y="{v:.1f}" width="16" height="{floor - v:.1f}" fill="{colour}"/>')
            else:
                parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3" fill="{colour}"/>')
            whisker = "#1b1f24" if self.bars else colour
            if high > low:
                ends = f'x1="{u:.1f}" y1="{top:.1f}" x2="{u:.1f}" y2="{bottom:.1f}"'
                parts.append(f'<line {ends} stroke="{whisker}"/>')
        if not self.bars and len(corners) > 1:
            parts.insert(
                0, f'<polyline points="{" ".join(corners)}" fill="none" stroke="{colour}" stroke-width="1.5"/>'
            )
        return parts


def figure(panels: Sequence[Panel], names: Mapping[str, str], columns: int = 4) -> str:
    """Return panels in rows, with a legend below.

    Args:
        panels: One or more.
        names: Texts of the legend by key of COLOURS.
        columns: Panels a row.
    """
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    width, height = max(columns * WIDTH, 120 * len(names)), rows * HEIGHT + 24
    parts = [
        f'<g transform="translate({index % columns * WIDTH} {index // columns * HEIGHT})">{panel.svg()}</g>'
        for index, panel in enumerate(panels)
    ]
    for index, (name, text) in enumerate(names.items()):
        x = LEFT + 120 * index
        parts.append(f'<rect x="{x}" y="{height - 16}" width="10" height="10" fill="{COLOURS[name]}"/>')
        parts.append(f'<text x="{x + 15}" y="{height - 7}">{escape(text)}</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    style = 'font-family="system-ui, sans-serif" font-size="11" fill="#1b1f24"'
    return f'{head} {style}><rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n'


def _chosen(lines: Sequence[Line], preset: str) -> list[Line]:
    """Return the lines that the paper's figures are drawn from."""
    found = latest(lines, DEFAULT_VARIANT)
    return [line for line in found if (line["region"], line["preset"]) == (DEFAULT_REGION, preset)]


def size_figure(lines: Sequence[Line], preset: str = "cpu") -> str:
    """Return success against the number of training episodes, a panel a task and one for their mean."""
    chosen = _chosen(lines, preset)
    cells = group(chosen, "task", "policy", "num_train_episodes")
    if not cells:
        return ""
    tasks = list(dict.fromkeys(task for task, *_ in cells))
    ages = {line["task"]: age(line) for line in chosen}
    sizes = sorted({size for *_, size in cells} | set(paper.SIZES))
    span = math.log(sizes[-1] / sizes[0])
    places = {size: math.log(size / sizes[0]) / span for size in sizes}
    ticks = [(places[size], str(size)) for size in paper.SIZES]
    policies = [policy for policy in POLICIES if any(key[1] == policy for key in cells)]

    def curves(names: Sequence[str]) -> list[Curve]:
        theirs = []
        for size in paper.SIZES:
            rates = [value / 100 for task in names if (value := paper.success(task, size)) is not None]
            if len(rates) == len(names):
                theirs.append((places[size], *[float(np.mean(rates))] * 3))
        found = [Curve(name="paper", points=theirs)]
        for policy in policies:
            ours = []
            for size in sizes:
                had = [cells[task, policy, size] for task in names if (task, policy, size) in cells]
                if len(had) == len(names):
                    ours.append((places[size], *(rate(had[0]) if len(had) == 1 else mean_rate(had))))
            found.append(Curve(name=policy, points=ours))
        return found

    panels = [Panel(title=task + ages[task], ticks=ticks, curves=curves([task])) for task in tasks]
    if len(tasks) > 1:
        panels.append(Panel(title=f"mean of {len(tasks)} tasks", ticks=ticks, curves=curves(tasks)))
    return figure(panels, {policy: TITLES[policy] for policy in policies} | {"paper": "paper (ACT)"})


def architectures_figure(lines: Sequence[Line], preset: str = "cpu") -> str:
    """Return bars of success by policy, a panel a task, at the size that most policies have, the largest of several."""
    panels = []
    chosen = _chosen(lines, preset)
    for (task,), found in group(chosen, "task").items():
        by_size = group(found, "num_train_episodes", "policy")
        count, size = max((count, size) for size, count in Counter(size for size, _ in by_size).items())
        if count < 2:
            continue
        theirs, curves, ticks = paper.SUCCESS_BY_ARCHITECTURE.get(task, {}), [], []
        for index, policy in enumerate(POLICIES):
            where = (2 * index + 1) / (2 * len(POLICIES))
            ticks.append((where, TITLES[policy]))
            if policy in theirs:
                share = theirs[policy] / 100
                curves.append(Curve(name="paper", points=[(where + 0.05, share, share, share)]))
            if (size, policy) in by_size:
                mean, low, high = rate(by_size[size, policy])
                curves.append(Curve(name=policy, points=[(where - 0.04, mean, low, high)]))
        panels.append(Panel(title=f"{task}, {size} episodes{age(found[0])}", ticks=ticks, curves=curves, bars=True))
    names = {policy: TITLES[policy] for policy in POLICIES} | {"paper": f"paper ({paper.ARCHITECTURE_SIZE})"}
    return figure(panels, names) if panels else ""


def regions_figure(lines: Sequence[Line]) -> str:
    """Return the success of generation by region, a panel a task with all three regions."""
    ticks = [((2 * index + 1) / 6, region) for index, region in enumerate(REGIONS)]
    panels = []
    for task, found in by_region(lines).items():
        ours, theirs = [], []
        for (where, region), line in zip(ticks, found, strict=True):
            successes, attempts = line["successes"], line["attempts"]
            ours.append((where, successes / attempts, *wilson(successes, attempts)))
            if (task, region) in paper.GENERATION:
                theirs.append((where, *[paper.GENERATION[task, region] / 100] * 3))
        curves = [Curve(name="paper", points=theirs), Curve(name="generation", points=ours)]
        panels.append(Panel(title=task + age(found[0]), ticks=ticks, curves=curves))
    return figure(panels, {"generation": "generation", "paper": "paper"}) if panels else ""


def failure_map(records: Sequence[Mapping[str, Any]], bins: int = 8, size: int = 260) -> str:
    """Return a heat map of failures over where the robot stood at the start.

    Args:
        records: Rollouts of one task and region.
        bins: Cells along the longer side.
        size: Its length [px].
    """
    starts = np.array([record["initial_state"]["robot"][:2] for record in records], dtype=float)  # (N, 2) [m]
    failed = np.array([not record["success_held"] for record in records])
    low, high = starts.min(axis=0), starts.max(axis=0) + 1e-6
    edge = (high - low).max() / bins
    shape = np.maximum(1, np.ceil((high - low) / edge - 1e-9)).astype(int)
    cells = np.minimum(((starts - low) / edge).astype(int), shape - 1)
    side = size / bins
    parts = []
    for x, y in np.ndindex(*shape):
        inside = (cells == (x, y)).all(axis=1)
        count, bad = int(inside.sum()), int(failed[inside].sum())
        share = bad / count if count else 0.0
        colour = (
            f"rgb({round(246 - 65 * share)},{round(248 - 176 * share)},{round(250 - 203 * share)})" if count else "none"
        )
        u, v = x * side, (shape[1] - 1 - y) * side
        parts.append(
            f'<rect x="{u:.1f}" y="{v:.1f}" width="{side:.1f}" height="{side:.1f}" fill="{colour}" stroke="#c8ced6">'
            f"<title>{bad} of {count} failed</title></rect>"
        )
        if bad:
            parts.append(
                f'<text x="{u + side / 2:.1f}" y="{v + side / 2 + 4:.1f}" text-anchor="middle">{bad}/{count}</text>'
            )
    width, height = shape * side
    label = f"x {low[0]:.2f} to {high[0]:.2f} m, y {low[1]:.2f} to {high[1]:.2f} m"
    parts.append(f'<text x="0" y="{height + 14:.0f}">{label}</text>')
    size_text = f'width="{width:.0f}" height="{height + 18:.0f}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size_text} font-size="10">{"".join(parts)}</svg>'
