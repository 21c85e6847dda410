"""Numbers -> figures for pages that explain: curves over time, a plan from above, maps of rates, histograms, bars."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from lerobot_demohlm import drawing
from lerobot_demohlm.drawing import BAD, GOOD, GREY, INK, PAPER, rate_colour

LEFT, RIGHT = "#2f5fa8", "#b5482f"
COLOURS = ("#2f5fa8", "#b5482f", "#2f6f4f", "#8a5a9e", "#b8862b")
STAGE_COLOURS = {"locomotion": "#e3edf7", "pre_manipulation": "#fbf1dc", "manipulation": "#e4f1e7"}
OUTCOME_COLOURS = {
    "success": GOOD,
    "ik_failed": "#8a5a9e",
    "fell": BAD,
    "dropped": "#c98a2b",
    "collided": "#7a1f1f",
    "timeout": "#2f5fa8",
    "off_course": GREY,
}
_DASHES = (0, (4, 2.4))


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a chart.

    Attributes:
        name: In the legend; empty for a line that needs no entry.
        values: (n,) from the start to the end of the time axis; NaN leaves a gap.
        colour: Colour of the line.
        dashed: Whether the line is dashed: dashed for what was commanded, solid for what was measured.
    """

    name: str
    values: np.ndarray
    colour: str
    dashed: bool = False


def chart(
    title: str,
    curves: Sequence[Curve],
    duration_s: float,
    bands: Sequence[tuple[float, float, str]],
    marks: Mapping[str, float] | None = None,
    size: tuple[int, int] = (600, 150),
) -> Markup:
    """Return curves over time, on a background that shows the stages.

    Args:
        title: With the unit.
        curves: At least one.
        duration_s: Where the time axis ends [s].
        bands: (start [s], stop [s], colour) of the stages.
        marks: Times [s] of vertical lines, by what is written beside them.
        size: Width and height [px].
    """
    width, height = size
    figure = drawing.new_figure(width, height)
    axes = drawing.new_axes(figure, 52, 24, width - 62, height - 44)
    known = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in curves] or [np.zeros(1)])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    margin = 0.08 * (high - low) if high - low > 1e-9 else max(0.1 * abs(high), 0.01)
    axes.set(xlim=(0.0, max(duration_s, 1e-9)), ylim=(low - margin, high + margin))
    drawing.round_ticks(axes, across=8, up=4)
    axes.xaxis.set_major_formatter("{x:g} s")
    drawing.grid(axes, "y")
    for start, stop, colour in bands:
        axes.axvspan(start, stop, color=colour, linewidth=0, zorder=0)
    for words, when in (marks or {}).items():
        axes.axvline(when, color=INK, linewidth=1.0)
        late = when > 0.8 * duration_s
        axes.annotate(
            words,
            (when, 1.0),
            (-3 if late else 3, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="right" if late else "left",
            va="top",
            fontsize=drawing.FONT_SIZE,
            color=INK,
        )
    entries = {}
    for curve in curves:
        moments = np.linspace(0.0, duration_s, len(curve.values)) if len(curve.values) > 1 else np.zeros(1)
        look = {"color": curve.colour, "linestyle": _DASHES if curve.dashed else "-"}
        axes.plot(moments, drawing.broken(curve.values), linewidth=1.5, solid_joinstyle="round", **look)
        if curve.name:
            entries[curve.name] = look
    drawing.title(axes, title)
    drawing.legend(axes, entries)
    return drawing.svg(figure)


class Plan:
    """The floor seen from above, x to the right and y up, to the same scale.

    Args:
        points: (n, 2) all that must be seen [m].
        width: Length of the longer side [px].
        margin: Around the points [m].
    """

    def __init__(self, points: np.ndarray, width: int = 560, margin: float = 0.2) -> None:
        across, up = drawing.plan_size(points, margin, width)
        self._figure = drawing.new_figure(across + 66, up + 46)
        self.axes = drawing.new_axes(self._figure, 52, 8, across, up)
        drawing.equal_scale(self.axes, points, margin)
        drawing.round_ticks(self.axes, across=7, up=6)
        self.axes.set_facecolor(PAPER)
        drawing.grid(self.axes)
        _labels(self.axes, "x [m]", "y [m]")

    def trail(self, points: np.ndarray, colour: str, width: float = 1.6, dashed: bool = False) -> None:
        """Draw a line through points (n, 2) [m], broken where they are not finite."""
        x, y = drawing.broken(points).T
        self.axes.plot(x, y, color=colour, linewidth=width, linestyle=_DASHES if dashed else "-")

    def outline(self, corners: np.ndarray, T: np.ndarray, colour: str, dashed: bool = False) -> None:
        """Draw corners (n, 2) [m] that are given in a frame (4, 4), closed."""
        seen = corners @ T[:2, :2].T + T[:2, 3]
        self.trail(np.concatenate([seen, seen[:1]]), colour, 1.4, dashed)

    def robot(self, planar: np.ndarray, colour: str, words: str, dashed: bool = False, line: int = 0) -> None:
        """Draw a robot at (x, y, yaw) as an arrowhead in its heading, its words ``line`` lines below others."""
        x, y, yaw = planar
        arrow = np.array([[0.13, 0.0], [-0.08, 0.09], [-0.04, 0.0], [-0.08, -0.09]])
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        corners = arrow @ turn.T + [x, y]
        if not dashed:
            self.axes.fill(*corners.T, color=colour, alpha=0.2, linewidth=0)
        self.trail(np.concatenate([corners, corners[:1]]), colour, 1.8, dashed)
        behind = np.array([x, y]) - 0.1 * np.array([math.cos(yaw), math.sin(yaw)])
        self.words(behind, words, colour, line)

    def frame(self, T: np.ndarray, words: str, beside: int = 0, size: float = 0.09) -> None:
        """Draw the x axis (red) and y axis (green) of a frame (4, 4); the words stand beside one of them, 0 or 1."""
        for axis, colour in ((0, "#c0392b"), (1, "#27834b")):
            tip = T[:2, 3] + size * T[:2, axis]
            self.trail(np.stack([T[:2, 3], tip]), colour, 2.2)
        self.words(T[:2, 3] + size * T[:2, beside], words, INK)

    def words(self, point: np.ndarray, words: str, colour: str = INK, line: int = 0) -> None:
        """Write beside a point (2,) [m], some lines further down."""
        self.axes.annotate(
            words,
            (float(point[0]), float(point[1])),
            (5, 5 - 14 * line),
            textcoords="offset points",
            fontsize=drawing.FONT_SIZE + 1,
            color=colour,
            bbox={"facecolor": PAPER, "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
        )

    def markup(self) -> Markup:
        """Return the drawing for a page."""
        return drawing.svg(self._figure)


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One number of an initial state.

    Attributes:
        name: In words, with the unit.
        values: (n,) of each attempt, in that unit.
        low: Lower end of the region.
        high: Upper end of the region.
    """

    name: str
    values: np.ndarray
    low: float
    high: float

    def bins(self, count: int) -> np.ndarray:
        """Return in which of equal parts of the range each value is, (n,)."""
        share = (self.values - self.low) / max(self.high - self.low, 1e-12)
        return np.clip((share * count).astype(int), 0, count - 1)


def rate_map(
    across: Axis, up: Axis, success: np.ndarray, dots: Sequence[tuple[int, str, str]], size: int = 300
) -> Markup:
    """Return a map of success rates over two numbers of the initial state, with a dot for each failed attempt.

    Args:
        across: Number on the horizontal axis.
        up: Number on the vertical axis.
        success: (n,) bool.
        dots: (row, colour, words) of attempts to show one by one.
        size: Side of the square [px].
    """
    count = int(np.clip(round(math.sqrt(len(success) / 6)), 1, 8))
    figure = drawing.new_figure(size + 76, size + 50)
    axes = drawing.new_axes(figure, 54, 10, size, size)
    axes.set(xlim=(across.low, across.high), ylim=(up.low, up.high))
    drawing.round_ticks(axes, across=4, up=4)
    _labels(axes, across.name, up.name)
    columns, rows = across.bins(count), up.bins(count)
    wide, tall = (across.high - across.low) / count, (up.high - up.low) / count
    for column in range(count):
        for row in range(count):
            inside = (columns == column) & (rows == row)
            n, good = int(inside.sum()), int(success[inside].sum())
            x, y = across.low + column * wide, up.low + row * tall
            cell = Rectangle((x, y), wide, tall, facecolor=rate_colour(good / n) if n else PAPER, edgecolor="white")
            drawing.add_tip(cell, f"{good} of {n} attempts succeeded")
            axes.add_patch(cell)
            if n:
                axes.text(x + wide / 2, y + tall / 2, f"{good}/{n}", fontsize=10, ha="center", va="center", color=INK)
    for row, colour, words in dots:
        (dot,) = axes.plot(
            across.values[row], up.values[row], "o", color=colour, markersize=7, markeredgecolor="white", clip_on=False
        )
        drawing.add_tip(dot, words)
    return drawing.svg(figure)


def histogram(title: str, groups: Mapping[str, tuple[np.ndarray, str]], size: tuple[int, int] = (280, 130)) -> Markup:
    """Return stacked bars of how often values occur.

    Args:
        title: With the unit.
        groups: Values (n,) and colour by name.
        size: Width and height [px].
    """
    width, height = size
    figure = drawing.new_figure(width, height)
    axes = drawing.new_axes(figure, 34, 24, width - 48, height - 44)
    everything = np.concatenate([values for values, _ in groups.values()])
    low, high = float(everything.min()), float(everything.max())
    low, high = (low - 0.5, high + 0.5) if high - low < 1e-6 else (low, high)
    edges = np.linspace(low, high, 21)
    base, middles = np.zeros(20), (edges[:-1] + edges[1:]) / 2
    for name, (values, colour) in groups.items():
        counts = np.histogram(values, edges)[0]
        bars = axes.bar(middles, counts, 0.9 * (edges[1] - edges[0]), bottom=base, color=colour)
        for column, bar in enumerate(bars):
            drawing.add_tip(bar, f"{counts[column]} {name}, {edges[column]:.2g} to {edges[column + 1]:.2g}")
        base += counts
    axes.set(xlim=(low, high), ylim=(0, 1.05 * max(1.0, base.max())))
    drawing.round_ticks(axes, across=4)
    axes.set_yticks([0, int(max(1.0, base.max()))])
    _open(axes)
    drawing.title(axes, title)
    return drawing.svg(figure)


def rate_bars(axis: Axis, success: np.ndarray, intervals: Sequence[tuple[float, float]], count: int) -> Markup:
    """Return success rates over one number of the initial state, with their intervals.

    Args:
        axis: The number.
        success: (n,) bool.
        intervals: Lower and upper end for each bin.
        count: Number of bins.
    """
    figure = drawing.new_figure(280, 130)
    axes = drawing.new_axes(figure, 46, 24, 216, 84)
    axes.set(xlim=(axis.low, axis.high), ylim=(0, 103))
    axes.set_yticks([0, 50, 100], ["0 %", "50 %", "100 %"])
    drawing.round_ticks(axes, across=4)
    drawing.grid(axes, "y")
    _open(axes)
    step, bins = (axis.high - axis.low) / count, axis.bins(count)
    for column in range(count):
        inside = bins == column
        n, good = int(inside.sum()), int(success[inside].sum())
        if n:
            middle = axis.low + (column + 0.5) * step
            (bar,) = axes.bar(middle, 100 * good / n, 0.94 * step, color=rate_colour(good / n))
            drawing.add_tip(bar, f"{good} of {n}")
            low, high = intervals[column]
            axes.vlines(middle, 100 * low, 100 * high, GREY, linewidth=1.2)
    drawing.title(axes, axis.name)
    return drawing.svg(figure)


def _labels(axes: Axes, across: str, up: str) -> None:
    axes.set_xlabel(across, fontsize=drawing.FONT_SIZE + 1, color=INK, labelpad=2)
    axes.set_ylabel(up, fontsize=drawing.FONT_SIZE + 1, color=INK, labelpad=2)


def _open(axes: Axes) -> None:
    """Leave only the lower line of a frame."""
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
