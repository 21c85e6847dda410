"""Success rates with their intervals -> one image with a panel for each thing that was varied."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

Point = tuple[float, float, float, float]
"""What was varied, the success rate, and the ends of its interval."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture of curves.

    Attributes:
        title: Above it.
        label: Of the horizontal axis, with its unit.
        curves: Points by the name of their curve; a curve of less than two points is left out.
    """

    title: str
    label: str
    curves: Mapping[str, Sequence[Point]]


def draw_panels(panels: Sequence[Panel], label: str, figure: Path, panel_size: tuple[float, float]) -> None:
    """Draw panels beside one another.

    Args:
        panels: From left to right.
        label: Of the vertical axis that they share.
        figure: Image file; its folder is made.
        panel_size: Width and height of each [inch].
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    size = panel_size[0] * len(panels), panel_size[1]
    picture, places = pyplot.subplots(1, len(panels), figsize=size, sharey=True, squeeze=False)
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    drawn = {}  # a curve may be missing in some panels
    for place, panel in zip(places[0], panels, strict=True):
        for name, points in panel.curves.items():
            if len(points) > 1:
                x, rate, low, high = zip(*points, strict=True)
                color = f"C{names.index(name)}"  # the same in all panels
                (line,) = place.plot(x, rate, marker="o", markersize=3, label=name, color=color)
                place.fill_between(x, low, high, alpha=0.12, color=color, linewidth=0)
                drawn.setdefault(name, line)
        place.set_title(panel.title, fontsize=9)
        place.set_xlabel(panel.label)
        place.set_ylim(-0.02, 1.02)
        place.grid(alpha=0.3)
    places[0, 0].set_ylabel(label)
    picture.legend(list(drawn.values()), list(drawn), loc="lower center", ncol=4, fontsize=8, frameon=False)
    picture.tight_layout(rect=(0, 0.08, 1, 1))
    figure.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(figure, dpi=110)
    pyplot.close(picture)
