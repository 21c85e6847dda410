"""Matplotlib figures -> SVG for pages, SVG and PNG files; a figure gives the same bytes on every run.

Sizes are in pixels of a page: figures have 72 dots per inch, so that one point of Matplotlib is one pixel.
"""

import io
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

INK, GREY, PALE, PAPER = "#1b1f24", "#57606a", "#d8dee4", "#f6f8fa"
GOOD, BAD = "#2f6f4f", "#b5482f"
FONT_SIZE = 10  # px
_DOTS = 72
_SVG = "http://www.w3.org/2000/svg"
_XLINK = "http://www.w3.org/1999/xlink"
_TIP = "tip:"  # begins the id of an element with a tooltip
_RC: dict[Any, Any] = {
    "svg.hashsalt": "demohlm",
    "svg.fonttype": "none",
}  # ids that do not change, text that stays text


def new_figure(width: float, height: float) -> Figure:
    """Return an empty white figure.

    Args:
        width: [px].
        height: [px].
    """
    return Figure(figsize=(width / _DOTS, height / _DOTS), dpi=_DOTS, facecolor="white")


def new_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Add a plot with light axes to a figure.

    Args:
        figure: The figure.
        left: From the figure's left edge to the plot [px].
        top: From the figure's upper edge to the plot [px].
        width: Of the plot, without its labels [px].
        height: Of the plot, without its labels [px].
    """
    across, down = figure.get_size_inches() * _DOTS
    axes = figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))
    for spine in axes.spines.values():
        spine.set(color=PALE, linewidth=0.8)
    axes.tick_params(colors=GREY, labelsize=FONT_SIZE, width=0.8, length=3, pad=2)
    axes.set_axisbelow(True)
    return axes


def grid(axes: Axes, which: str = "both") -> None:
    """Draw light lines at the ticks of "x", "y" or "both"."""
    axes.grid(axis=which, color=PALE, linewidth=0.7)  # pyright: ignore[reportArgumentType]


def round_ticks(axes: Axes, across: int | None = None, up: int | None = None) -> None:
    """Put about as many ticks as asked for at round numbers of an axis."""
    for axis, count in ((axes.xaxis, across), (axes.yaxis, up)):
        if count is not None:
            axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))


def title(axes: Axes, text: str, **style: object) -> None:
    """Write a plot's title above its left edge."""
    axes.set_title(text, loc="left", fontsize=FONT_SIZE + 1, color=INK, pad=5, **style)  # pyright: ignore


def legend(axes: Axes, entries: Mapping[str, Mapping[str, object]]) -> None:
    """Write a plot's legend above its right edge.

    Args:
        axes: The plot.
        entries: The look of a line ("color", "linestyle", ...) by its name.
    """
    if entries:
        handles = [Line2D([], [], linewidth=1.8, **look) for look in entries.values()]  # pyright: ignore
        axes.legend(
            handles,
            list(entries),
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(entries),
            frameon=False,
            fontsize=FONT_SIZE,
            labelcolor=GREY,
            borderaxespad=0.1,
            borderpad=0.2,
            handlelength=1.8,
            columnspacing=1.2,
        )


def add_tip(artist: Artist, text: str) -> None:
    """Give something drawn a text that a pointer on it brings up, in SVG."""
    artist.set_gid(_TIP + text)


def equal_scale(axes: Axes, points: np.ndarray, margin: float) -> None:
    """Set the limits of a plan so that points (n, 2) are seen with a margin around them, and both axes to one scale."""
    finite = points[np.isfinite(points).all(axis=1)]
    low, high = finite.min(axis=0) - margin, finite.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box", anchor="NW")


def plan_size(points: np.ndarray, margin: float, longest: float) -> tuple[float, float]:
    """Return width and height [px] of a plan of points (n, 2) whose longer side is given [px]."""
    finite = points[np.isfinite(points).all(axis=1)]
    extent = finite.max(axis=0) - finite.min(axis=0) + 2 * margin
    width, height = extent * longest / extent.max()
    return float(width), float(height)


def rate_colour(rate: float) -> str:
    """Return a colour between red for a rate of 0 and green for a rate of 1."""
    red, middle, green = (181, 72, 47), (244, 236, 218), (88, 160, 118)
    low, high, share = (red, middle, 2 * rate) if rate < 0.5 else (middle, green, 2 * rate - 1)
    return "#" + "".join(f"{round(a + (b - a) * share):02x}" for a, b in zip(low, high, strict=True))


def svg(figure: Figure) -> Markup:
    """Return a figure as an ``<svg>`` element for a page, which is a file of its own as well."""
    stream = io.StringIO()
    with matplotlib.rc_context(_RC):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    for prefix, name in (("", _SVG), ("xlink", _XLINK)):
        ET.register_namespace(prefix, name)
    root = ET.fromstring(stream.getvalue())
    for metadata in root.findall(f"{{{_SVG}}}metadata"):
        root.remove(metadata)
    for group in root.iter(f"{{{_SVG}}}g"):
        name = group.attrib.pop("id", "")  # several figures on a page would share these; nothing refers to them
        if name.startswith(_TIP):
            said = ET.Element(f"{{{_SVG}}}title")
            said.text = name.removeprefix(_TIP)
            group.insert(0, said)
    width, height = figure.get_size_inches() * _DOTS
    root.set("width", f"{width:.0f}")
    root.set("height", f"{height:.0f}")
    return Markup(ET.tostring(root, encoding="unicode"))


def png(figure: Figure, scale: float = 2.0) -> bytes:
    """Return a figure as a PNG of ``scale`` dots per pixel."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=scale * _DOTS, metadata={"Software": None})
    return stream.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write a figure as an SVG where the path ends in ``.svg``, as a PNG elsewhere; the folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".svg":
        path.write_text(svg(figure) + "\n")
    else:
        path.write_bytes(png(figure))


def broken(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return numbers with NaN for those that are not finite: Matplotlib breaks a line there."""
    array = np.asarray(values, dtype=float)
    return np.where(np.isfinite(array), array, np.nan)
