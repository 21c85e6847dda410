"""Lines of results -> figures: success by data size, by policy, by region, by strength of a variation; failures."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from gym_demohlm.task import DEFAULT_REGION
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm import drawing
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.experiments import paper
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import GRADED, REGIONS, STRENGTHS
from lerobot_demohlm.experiments.rates import TITLES, age_of, common_age, group, mean_rate, of_the_paper, rate
from lerobot_demohlm.experiments.robustness import Row
from lerobot_demohlm.experiments.tables import by_region
from lerobot_demohlm.policies.presets import POLICIES

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 270, 206, 48, 14, 38, 44  # of one panel and of its margins [px]
LEGEND = 28  # px, below the panels
COLOURS = {"mlp": "#2f6f4f", "act": "#2b5f9e", "diffusion": "#8a5aa8", "paper": "#9aa2ab", "generation": "#2f6f4f"}
COLOURS |= {"task": "#c3c9d0", "mean": "#2b5f9e"}
_BAR = 0.07  # of a panel's width


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a panel.

    Attributes:
        name: What it shows; a key of COLOURS.
        points: (place on the horizontal axis in [0, 1], rate, low, high), rates in [0, 1].
        tip: What tips call it; by default its name.
    """

    name: str
    points: Sequence[tuple[float, float, float, float]]
    tip: str = ""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One small plot, its vertical axis a rate from 0 to 100 %.

    Attributes:
        title: Above it.
        age: Below the title, as ``rates.age_of`` says it; nothing where every result is of this version.
        ticks: (place in [0, 1], text) along the horizontal axis.
        curves: What it shows.
        bars: Whether points are bars from below rather than joined by lines.
    """

    title: str
    age: str = ""
    ticks: Sequence[tuple[float, str]]
    curves: Sequence[Curve] = field(default_factory=tuple)
    bars: bool = False

    def draw(self, axes: Axes) -> None:
        """Draw the panel."""
        below = self.age.removeprefix(", ")
        drawing.title(axes, f"{self.title}\n{below}" if below else self.title, fontweight="bold")
        axes.set(xlim=(-0.04, 1.04), ylim=(0.0, 104.0), yticks=(0, 50, 100))
        axes.set_xticks([place for place, _ in self.ticks], [text for _, text in self.ticks])
        for side in ("top", "right", "left"):
            axes.spines[side].set_visible(False)
        drawing.grid(axes, "y")
        for curve in self.curves:
            places, means, lows, highs = 100 * np.array(curve.points, dtype=float).reshape(-1, 4).T
            places, colour = places / 100, COLOURS[curve.name]
            tip = [
                f"{curve.tip or curve.name}: {mean:.1f} %" + (f" ({low:.1f} to {high:.1f})" if high > low else "")
                for mean, low, high in zip(means, lows, highs, strict=True)
            ]
            if self.bars:
                for bar, text in zip(axes.bar(places, means, _BAR, color=colour), tip, strict=True):
                    drawing.add_tip(bar, text)
            else:
                axes.plot(places, means, "-", color=colour, linewidth=1.5)
                for place, mean, text in zip(places, means, tip, strict=True):
                    (dot,) = axes.plot(place, mean, "o", color=colour, markersize=5, clip_on=False)
                    drawing.add_tip(dot, text)
            wide = highs > lows
            axes.vlines(places[wide], lows[wide], highs[wide], drawing.INK if self.bars else colour, linewidth=1.2)


def figure(panels: Sequence[Panel], names: Mapping[str, str], across: str, columns: int = 4) -> Figure:
    """Return panels in rows, with a legend below.

    Args:
        panels: One or more.
        names: Texts of the legend by key of COLOURS.
        across: Label of their horizontal axes; empty where the ticks say it.
        columns: Panels a row.
    """
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    width, height = max(columns * WIDTH, 120 * len(names)), rows * HEIGHT + LEGEND
    drawn = drawing.new_figure(width, height)
    for index, panel in enumerate(panels):
        left, top = LEFT + index % columns * WIDTH, TOP + index // columns * HEIGHT
        axes = drawing.new_axes(drawn, left, top, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM)
        panel.draw(axes)
        axes.set_xlabel(across, fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
        axes.set_ylabel("success [%]", fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
    handles = [Patch(color=COLOURS[name], label=text) for name, text in names.items()]
    drawn.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=((LEFT - 8) / width, 0.0),
        ncols=len(handles),
        frameon=False,
        fontsize=drawing.FONT_SIZE,
        handlelength=1.0,
    )
    return drawn


def _chosen(lines: Sequence[PolicyResult], preset: str) -> list[PolicyResult]:
    """Return the results that the paper's figures are drawn from."""
    return [line for line in of_the_paper(lines) if (line.region, line.preset) == (DEFAULT_REGION, preset)]


def size_figure(lines: Sequence[PolicyResult], preset: str = "cpu") -> Figure | None:
    """Return success against the number of training episodes, a panel a task and one for their mean."""
    chosen = _chosen(lines, preset)
    cells = group(chosen, "task", "policy", "num_train_episodes")
    if not cells:
        return None
    tasks = list(dict.fromkeys(task for task, *_ in cells))
    ages = {task: age_of(found) for (task,), found in group(chosen, "task").items()}
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

    panels = [Panel(title=task, age=ages[task], ticks=ticks, curves=curves([task])) for task in tasks]
    if len(tasks) > 1:
        title = f"mean of {len(tasks)} tasks"
        panels.append(Panel(title=title, age=age_of(chosen), ticks=ticks, curves=curves(tasks)))
    names = {policy: TITLES[policy] for policy in policies} | {"paper": "paper (ACT)"}
    return figure(panels, names, "training episodes")


def architectures_figure(lines: Sequence[PolicyResult], preset: str = "cpu") -> Figure | None:
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
        title, drawn = f"{task}, {size} episodes", [line for line in found if line.num_train_episodes == size]
        panels.append(Panel(title=title, age=age_of(drawn), ticks=ticks, curves=curves, bars=True))
    names = {policy: TITLES[policy] for policy in POLICIES} | {"paper": f"paper ({paper.ARCHITECTURE_SIZE})"}
    return figure(panels, names, "") if panels else None


def regions_figure(lines: Sequence[GenerationResult]) -> Figure | None:
    """Return the success of generation by region, a panel a task with all three regions."""
    ticks = [((2 * index + 1) / 6, region) for index, region in enumerate(REGIONS)]
    panels = []
    for task, found in by_region(lines).items():
        ours, theirs = [], []
        for where, region in ticks:
            successes, attempts = found[region].successes, found[region].attempts
            ours.append((where, successes / attempts, *wilson(successes, attempts)))
            if (task, region) in paper.GENERATION:
                theirs.append((where, *[paper.GENERATION[task, region] / 100] * 3))
        curves = [Curve(name="paper", points=theirs), Curve(name="generation", points=ours)]
        aged = age_of([found[region] for region in REGIONS])
        panels.append(Panel(title=task, age=aged, ticks=ticks, curves=curves))
    return figure(panels, {"generation": "generation", "paper": "paper"}, "region") if panels else None


def robustness_figure(rows: Sequence[Row]) -> Figure | None:
    """Return strict success against the strength of a variation, a panel a group: a line a policy, and their mean."""
    places = [strength / STRENGTHS[-1] for strength in (0.0, *STRENGTHS)]
    ticks = [(place, f"{strength:g}") for place, strength in zip(places, (0.0, *STRENGTHS), strict=True)]
    panels = []
    for name in GROUPS:
        rates = {row.name + row.age: [share for _, share, _, _ in row.points(name)] for row in rows}
        whole = {policy: shares for policy, shares in rates.items() if len(shares) == len(places)}
        if whole:
            drawn = {**whole, f"mean of {len(whole)}": np.mean(list(whole.values()), axis=0).tolist()}
            curves = [
                Curve(
                    name="task" if policy in whole else "mean",
                    points=[(place, share, share, share) for place, share in zip(places, shares, strict=True)],
                    tip=policy,
                )
                for policy, shares in drawn.items()
            ]
            aged = common_age([row.age for row in rows if row.name + row.age in whole])
            panels.append(Panel(title=name, age=aged, ticks=ticks, curves=curves))
    names = {"mean": "mean", "task": "one task"}
    return figure(panels, names, f"strength of {GRADED}", columns=3) if panels else None


def failure_map(rollouts: Sequence[Rollout], bins: int = 8, size: int = 260) -> Figure:
    """Return a heat map of failures over where the robot stood at the start.

    Args:
        rollouts: Of one task and region.
        bins: Cells along the longer side.
        size: Length of the longer side [px].
    """
    starts = np.array([rollout.initial_state["robot"][:2] for rollout in rollouts], dtype=float)  # (N, 2) [m]
    failed = np.array([not rollout.succeeded for rollout in rollouts])
    low, high = starts.min(axis=0), starts.max(axis=0) + 1e-6
    edge = (high - low).max() / bins
    shape = np.maximum(1, np.ceil((high - low) / edge - 1e-9)).astype(int)
    cells = np.minimum(((starts - low) / edge).astype(int), shape - 1)
    width, height = shape * size / bins
    drawn = drawing.new_figure(width + 70, height + 46)
    axes = drawing.new_axes(drawn, 52, 8, width, height)
    axes.set(xlim=(low[0], low[0] + shape[0] * edge), ylim=(low[1], low[1] + shape[1] * edge))
    axes.set_xlabel("x [m]", fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
    axes.set_ylabel("y [m]", fontsize=drawing.FONT_SIZE, color=drawing.GREY, labelpad=1)
    drawing.round_ticks(axes, across=4 if width > 120 else 2, up=4 if height > 80 else 1)
    for x, y in np.ndindex(*shape):
        inside = (cells == (x, y)).all(axis=1)
        count, bad = int(inside.sum()), int(failed[inside].sum())
        corner = low + edge * np.array([x, y])
        colour = drawing.rate_colour(1 - bad / count) if count else "none"
        cell = Rectangle((corner[0], corner[1]), edge, edge, facecolor=colour, edgecolor="#c8ced6", linewidth=0.7)
        drawing.add_tip(cell, f"{bad} of {count} failed")
        axes.add_patch(cell)
        if bad:
            axes.text(
                corner[0] + edge / 2,
                corner[1] + edge / 2,
                f"{bad}/{count}",
                fontsize=9,
                ha="center",
                va="center",
                color=drawing.INK,
            )
    return drawn
