"""Numbers -> SVG figures for HTML pages: curves over time, a plan seen from above, maps of rates, histograms, bars."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

INK, GREY, PALE, PAPER = "#1b1f24", "#57606a", "#d8dee4", "#f6f8fa"
GOOD, BAD = "#2f6f4f", "#b5482f"
LEFT, RIGHT = "#2f5fa8", "#b5482f"
COLOURS = ("#2f5fa8", "#b5482f", "#2f6f4f", "#8a5a9e", "#b8862b")
STAGE_COLOURS = {"locomotion": "#e3edf7", "pre_manipulation": "#fbf1dc", "manipulation": "#e4f1e7"}
OUTCOME_COLOURS = {
    "success": GOOD,
    "ik_failed": "#8a5a9e",
    "fell": "#b5482f",
    "dropped": "#c98a2b",
    "collided": "#7a1f1f",
    "timeout": "#2f5fa8",
    "off_course": "#57606a",
}


class Svg:
    """A drawing that is put together piece by piece.

    Args:
        width: [px].
        height: [px].
    """

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self._parts: list[str] = []

    def line(self, x1: float, y1: float, x2: float, y2: float, colour: str = PALE, width: float = 1.0) -> None:
        """Add a line."""
        ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
        self._parts.append(f'<line {ends} stroke="{colour}" stroke-width="{width:g}"/>')

    def path(self, points: np.ndarray, colour: str, width: float = 1.6, dashes: str = "", fill: str = "none") -> None:
        """Add a line through points (n, 2) [px], broken where they are not finite."""
        started, words = False, []
        for x, y in points:
            if not (math.isfinite(x) and math.isfinite(y)):
                started = False
                continue
            words.append(f"{'L' if started else 'M'}{x:.1f} {y:.1f}")
            started = True
        if words:
            dash = f' stroke-dasharray="{dashes}"' if dashes else ""
            self._parts.append(
                f'<path d="{"".join(words)}" fill="{fill}" stroke="{colour}" stroke-width="{width:g}"{dash} '
                'stroke-linejoin="round"/>'
            )

    def rectangle(self, x: float, y: float, width: float, height: float, fill: str, title: str = "") -> None:
        """Add a rectangle, with a text that a pointer brings up."""
        said = f"<title>{escape(title)}</title>" if title else ""
        place = f'x="{x:.1f}" y="{y:.1f}" width="{max(width, 0.0):.1f}" height="{max(height, 0.0):.1f}"'
        self._parts.append(f'<rect {place} fill="{fill}">{said}</rect>')

    def circle(self, x: float, y: float, radius: float, fill: str, title: str = "") -> None:
        """Add a dot, with a text that a pointer brings up."""
        said = f"<title>{escape(title)}</title>" if title else ""
        self._parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}" stroke="white" stroke-width="0.8">{said}'
            "</circle>"
        )

    def text(self, x: float, y: float, words: str, colour: str = GREY, size: int = 11, anchor: str = "start") -> None:
        """Add a text; anchor is "start", "middle" or "end"."""
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}">{escape(words)}'
            "</text>"
        )

    def markup(self) -> Markup:
        """Return the element."""
        size = f'width="{self.width:g}" height="{self.height:g}" viewBox="0 0 {self.width:g} {self.height:g}"'
        style = 'font-family="system-ui, sans-serif"'
        return Markup(f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>{"".join(self._parts)}</svg>')


def ticks(low: float, high: float, count: int = 4) -> list[float]:
    """Return round numbers between two, about as many as asked for."""
    span = max(high - low, 1e-9)
    raw = span / count
    step = 10.0 ** math.floor(math.log10(raw))
    step *= next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * step >= raw - 1e-12)
    first = math.ceil(low / step - 1e-9)
    return [round(index * step, 10) for index in range(first, math.floor(high / step + 1e-9) + 1)]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One line of a chart.

    Attributes:
        name: In the legend; empty for one that needs no entry.
        values: (n,) from the start to the end of the time axis; NaN leaves a gap.
        colour: Of the line.
        dashed: What was asked for is dashed, what was measured is not.
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
        marks: Vertical lines by their words [s].
        size: Width and height [px].
    """
    width, height = size
    left, right, top, bottom = 52.0, width - 10.0, 26.0, height - 20.0
    svg = Svg(width, height)
    known = np.concatenate([curve.values[np.isfinite(curve.values)] for curve in curves] or [np.zeros(1)])
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    margin = 0.08 * (high - low) if high - low > 1e-9 else max(0.1 * abs(high), 0.01)
    low, high = low - margin, high + margin

    def place(times: np.ndarray | float, values: np.ndarray | float) -> np.ndarray:
        x = left + (right - left) * np.asarray(times) / max(duration_s, 1e-9)
        y = bottom - (bottom - top) * (np.asarray(values) - low) / (high - low)
        return np.stack(np.broadcast_arrays(x, y), axis=-1)

    for start, stop, colour in bands:
        svg.rectangle(place(start, low)[0], top, place(stop, low)[0] - place(start, low)[0], bottom - top, colour)
    for value in ticks(low, high):
        y = place(0.0, value)[1]
        svg.line(left, y, right, y)
        svg.text(left - 6, y + 4, f"{value:g}", anchor="end")
    for second in ticks(0.0, duration_s, 8):
        x = place(second, low)[0]
        svg.line(x, bottom, x, bottom + 4, GREY)
        svg.text(x, bottom + 16, f"{second:g} s", anchor="middle")
    for words, when in (marks or {}).items():
        x = place(when, low)[0]
        svg.line(x, top, x, bottom, INK)
        svg.text(x + 3, top + 11, words, INK)
    for curve in curves:
        moments = np.linspace(0.0, duration_s, len(curve.values)) if len(curve.values) > 1 else np.zeros(1)
        svg.path(place(moments, curve.values), curve.colour, dashes="5 3" if curve.dashed else "")
    svg.text(left, 14, title, INK, 12)
    x = right
    for curve in reversed([curve for curve in curves if curve.name]):
        x -= 7.5 * len(curve.name) + 44
        svg.path(np.array([[x, 10.0], [x + 22, 10.0]]), curve.colour, 2.2, "5 3" if curve.dashed else "")
        svg.text(x + 27, 14, curve.name)
    return svg.markup()


class Plan:
    """The floor seen from above, x to the right and y up, to the same scale.

    Args:
        points: (n, 2) all that must be seen [m].
        width: [px].
        margin: Around them [m].
    """

    def __init__(self, points: np.ndarray, width: int = 560, margin: float = 0.2) -> None:
        finite = points[np.isfinite(points).all(axis=1)]
        self._low, self._high = finite.min(axis=0) - margin, finite.max(axis=0) + margin
        extent = self._high - self._low
        self._scale = width / extent.max()
        self.svg = Svg(extent[0] * self._scale, extent[1] * self._scale)
        self.svg.rectangle(0, 0, self.svg.width, self.svg.height, PAPER)
        for x in ticks(self._low[0], self._high[0], 6):
            self.svg.path(self.place(np.array([[x, self._low[1]], [x, self._high[1]]])), PALE, 0.8)
            self.svg.text(self.place(np.array([x, 0.0]))[0] + 3, self.svg.height - 4, f"x {x:g} m", size=10)
        for y in ticks(self._low[1], self._high[1], 5):
            self.svg.path(self.place(np.array([[self._low[0], y], [self._high[0], y]])), PALE, 0.8)
            height = self.place(np.array([0.0, y]))[1]
            if height > 14:
                self.svg.text(4, height - 3, f"y {y:g} m", size=10)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 2) [m] are drawn [px]."""
        flipped = np.stack([points[..., 0] - self._low[0], self._high[1] - points[..., 1]], axis=-1)
        return flipped * self._scale

    def trail(self, points: np.ndarray, colour: str, width: float = 1.6, dashes: str = "") -> None:
        """Draw a line through points (n, 2) [m]."""
        self.svg.path(self.place(points), colour, width, dashes)

    def outline(self, corners: np.ndarray, T: np.ndarray, colour: str, dashes: str = "") -> None:
        """Draw corners (n, 2) [m] that are given in a frame (4, 4), closed."""
        seen = corners @ T[:2, :2].T + T[:2, 3]
        self.svg.path(self.place(np.concatenate([seen, seen[:1]])), colour, 1.4, dashes)

    def robot(self, planar: np.ndarray, colour: str, words: str, dashes: str = "", line: int = 0) -> None:
        """Draw a robot at (x, y, yaw): an arrowhead in its heading; its words stand so many lines below the others."""
        x, y, yaw = planar
        arrow = np.array([[0.13, 0.0], [-0.08, 0.09], [-0.04, 0.0], [-0.08, -0.09]])
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        seen = self.place(arrow @ turn.T + [x, y])
        self.svg.path(np.concatenate([seen, seen[:1]]), colour, 1.8, dashes, fill="none" if dashes else f"{colour}33")
        behind = np.array([x, y]) - 0.1 * np.array([math.cos(yaw), math.sin(yaw)])
        self.words(behind, words, colour, line)

    def frame(self, T: np.ndarray, words: str, beside: int = 0, size: float = 0.09) -> None:
        """Draw the x axis (red) and y axis (green) of a frame (4, 4); the words stand beside one of them, 0 or 1."""
        for axis, colour in ((0, "#c0392b"), (1, "#27834b")):
            tip = T[:2, 3] + size * T[:2, axis]
            self.svg.path(self.place(np.stack([T[:2, 3], tip])), colour, 2.2)
        self.words(T[:2, 3] + size * T[:2, beside], words, INK)

    def words(self, point: np.ndarray, words: str, colour: str = INK, line: int = 0) -> None:
        """Write beside a point (2,) [m], some lines further down."""
        x, y = self.place(point)
        self.svg.text(x + 5, y - 5 + 14 * line, words, colour)


def rate_colour(rate: float) -> str:
    """Return a colour between red (0) and green (1)."""
    red, middle, green = (181, 72, 47), (244, 236, 218), (88, 160, 118)
    low, high, share = (red, middle, 2 * rate) if rate < 0.5 else (middle, green, 2 * rate - 1)
    return "#" + "".join(f"{round(a + (b - a) * share):02x}" for a, b in zip(low, high, strict=True))


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One number of an initial state.

    Attributes:
        name: In words, with the unit.
        values: (n,) of each attempt, in that unit.
        low: Of the region.
        high: Of the region.
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
        size: Of the square [px].
    """
    count = int(np.clip(round(math.sqrt(len(success) / 6)), 1, 8))
    left, top = 54.0, 22.0
    svg, cell = Svg(size + left + 22, size + top + 36), size / count
    columns, rows = across.bins(count), up.bins(count)
    for column in range(count):
        for row in range(count):
            inside = (columns == column) & (rows == row)
            n, good = int(inside.sum()), int(success[inside].sum())
            x, y = left + column * cell, top + (count - 1 - row) * cell
            fill = rate_colour(good / n) if n else PAPER
            svg.rectangle(x + 0.5, y + 0.5, cell - 1, cell - 1, fill, f"{good} of {n} attempts succeeded")
            if n:
                svg.text(x + cell / 2, y + cell / 2 + 4, f"{good}/{n}", INK, 10, "middle")
    for row, colour, words in dots:
        x = left + size * (across.values[row] - across.low) / max(across.high - across.low, 1e-12)
        y = top + size * (1 - (up.values[row] - up.low) / max(up.high - up.low, 1e-12))
        svg.circle(x, y, 3.5, colour, words)
    for value in ticks(across.low, across.high, 4):
        x = left + size * (value - across.low) / max(across.high - across.low, 1e-12)
        svg.text(x, top + size + 14, f"{value:g}", anchor="middle")
    for value in ticks(up.low, up.high, 4):
        y = top + size * (1 - (value - up.low) / max(up.high - up.low, 1e-12))
        svg.text(left - 5, y + 4, f"{value:g}", anchor="end")
    svg.text(left + size / 2, top + size + 30, across.name, INK, 12, "middle")
    svg.text(left, 14, up.name, INK, 12)
    return svg.markup()


def histogram(title: str, groups: Mapping[str, tuple[np.ndarray, str]], size: tuple[int, int] = (280, 130)) -> Markup:
    """Return stacked bars of how often values occur.

    Args:
        title: With the unit.
        groups: Values (n,) and colour by name.
        size: Width and height [px].
    """
    width, height = size
    left, right, top, bottom = 30.0, width - 14.0, 22.0, height - 20.0
    svg = Svg(width, height)
    everything = np.concatenate([values for values, _ in groups.values()])
    low, high = float(everything.min()), float(everything.max())
    low, high = (low - 0.5, high + 0.5) if high - low < 1e-6 else (low, high)
    edges = np.linspace(low, high, 21)
    counts = {name: np.histogram(values, edges)[0] for name, (values, _) in groups.items()}
    most = max(1, int(sum(counts.values(), np.zeros(20, dtype=int)).max()))
    base, step = np.zeros(20), (right - left) / 20
    for name, (_, colour) in groups.items():
        for column, count in enumerate(counts[name]):
            tall = (bottom - top) * count / most
            y = bottom - (bottom - top) * base[column] / most - tall
            words = f"{count} {name}, {edges[column]:.2g} to {edges[column + 1]:.2g}"
            if count:
                svg.rectangle(left + column * step + 0.5, y, step - 1, tall, colour, words)
        base += counts[name]
    svg.line(left, bottom, right, bottom, GREY)
    for value in ticks(low, high, 4):
        svg.text(left + (right - left) * (value - low) / (high - low), bottom + 14, f"{value:g}", anchor="middle")
    svg.text(left - 4, top + 8, str(most), anchor="end")
    svg.text(left, 13, title, INK, 12)
    return svg.markup()


def rate_bars(axis: Axis, success: np.ndarray, intervals: Sequence[tuple[float, float]], count: int) -> Markup:
    """Return success rates over one number of the initial state, with their intervals.

    Args:
        axis: The number.
        success: (n,) bool.
        intervals: Lower and upper end for each bin.
        count: Bins.
    """
    width, height = 280.0, 130.0
    left, right, top, bottom = 34.0, width - 20.0, 22.0, height - 20.0
    svg, step, bins = Svg(width, height), (right - left) / count, axis.bins(count)
    for share in (0.0, 0.5, 1.0):
        y = bottom - (bottom - top) * share
        svg.line(left, y, right, y)
        svg.text(left - 4, y + 4, f"{100 * share:.0f} %", anchor="end", size=9)
    for column in range(count):
        inside = bins == column
        n, good = int(inside.sum()), int(success[inside].sum())
        if not n:
            continue
        x, tall = left + column * step, (bottom - top) * good / n
        svg.rectangle(x + 1, bottom - tall, step - 2, tall, rate_colour(good / n), f"{good} of {n}")
        low, high = (bottom - (bottom - top) * end for end in intervals[column])
        svg.line(x + step / 2, low, x + step / 2, high, GREY, 1.2)
    for value in ticks(axis.low, axis.high, 4):
        x = left + (right - left) * (value - axis.low) / max(axis.high - axis.low, 1e-12)
        svg.text(x, bottom + 14, f"{value:g}", anchor="middle")
    svg.text(left, 13, axis.name, INK, 12)
    return svg.markup()
