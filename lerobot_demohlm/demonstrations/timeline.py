"""A demonstration -> a figure of its timeline: contact forces, gripper commands and what each hand follows when."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from gym_demohlm.timing import FPS, STEP_DT
from lerobot_demohlm import drawing
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import events, segment
from lerobot_demohlm.demonstrations.segments import Event, Segment

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 1000, 190, 20, 40, 34  # px
CURVE, BAR, GAP = 52, 30, 22  # px: heights of a curve, of a bar, and between them
FOLLOWS = {"object": "#7ab2de", "proprioception": "#f4be78"}
CURVES = {"left": "#3668ac", "right": "#ba4a3e"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One row of the figure: a curve over time, or the segments of a hand.

    Attributes:
        hand: "left" or "right".
        title: What the row shows, with the unit.
        values: (T,) of a curve; None for segments.
        object: The object that a force acts on; None for a gripper.
    """

    hand: str
    title: str
    values: np.ndarray | None = None
    object: str | None = None

    def events_of(self, found: Sequence[Event]) -> list[Event]:
        """Return the events that belong to this curve: touches of its object, or of its gripper."""
        if self.values is None:
            return []
        return [event for event in found if event.hand == self.hand and event.object == self.object]


def rows(task: Task, demonstration: Demonstration) -> list[Row]:
    """Return the rows of a demonstration's figure, hand by hand: forces, the gripper, segments.

    Args:
        task: Task of the demonstration.
        demonstration: The demonstration.
    """
    found = []
    for hand in g1.SIDES:
        for column, (side, name) in enumerate(task.contact_pairs):
            if side == hand:
                forces = demonstration.contact_forces[:, column]
                found.append(Row(hand=hand, title=f"{hand} hand on {name} [N]", values=forces, object=name))
        if task.hands == "gripper":
            closed = demonstration.action[:, command.GRIPPERS][:, g1.SIDES.index(hand)]
            found.append(Row(hand=hand, title=f"{hand} gripper closed", values=closed))
        found.append(Row(hand=hand, title=f"{hand} hand follows"))
    return found


def draw_timeline(demonstration: Demonstration) -> Figure:
    """Return the figure: for each hand its forces on objects [N], its gripper where it has one, and its segments."""
    task = get_task(demonstration.task)
    segments, found = segment(demonstration, task), events(demonstration, task)
    shown = rows(task, demonstration)
    heights = [BAR if row.values is None else CURVE for row in shown]
    figure = drawing.new_figure(WIDTH, TOP + sum(heights) + GAP * len(shown) + BOTTOM - GAP)
    top = TOP
    for row, height in zip(shown, heights, strict=True):
        axes = drawing.new_axes(figure, LEFT, top, WIDTH - LEFT - RIGHT, height)
        axes.set_xlim(0.0, len(demonstration) * STEP_DT)
        drawing.round_ticks(axes, across=12)
        drawing.grid(axes, "x")
        _write_left(axes, row.title)
        if row.values is None:
            _draw_segments(axes, [entry for entry in segments if entry.hand == row.hand])
        else:
            _draw_curve(axes, row.values, CURVES[row.hand], row.events_of(found))
        if row is shown[-1]:
            axes.set_xlabel("time [s]", fontsize=11, color=drawing.INK, labelpad=2)
        else:
            axes.tick_params(labelbottom=False)
        if row is shown[0]:
            title = f"{task.name}: {len(demonstration)} ticks of {STEP_DT:g} s"
            axes.set_title(title, loc="left", fontsize=13, color=drawing.INK, pad=14)
        top += height + GAP
    return figure


def _write_left(axes: Axes, words: str) -> None:
    """Write what a row shows to its left, clear of its ticks."""
    axes.annotate(
        words,
        (0.0, 0.5),
        (-44, 0),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=11,
        color=drawing.INK,
    )


def _draw_curve(axes: Axes, values: np.ndarray, colour: str, marked: Sequence[Event]) -> None:
    most = max(1.0, float(values.max()))
    axes.set_ylim(0.0, 1.08 * most)
    axes.set_yticks([0.0, most], ["0", f"{most:.3g}"])
    axes.plot((np.arange(len(values)) + 0.5) / FPS, values, color=colour, linewidth=1.6)
    for event in marked:
        axes.axvline(event.tick / FPS, color=drawing.INK, linewidth=0.9)
        late = event.tick > 0.93 * len(values)
        axes.annotate(
            event.kind,
            (event.tick / FPS, 1.0),
            (0, 2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="right" if late else "left",
            va="bottom",
            fontsize=10,
            color=drawing.INK,
        )


def _draw_segments(axes: Axes, segments: Sequence[Segment]) -> None:
    axes.set(ylim=(0.0, 1.0), yticks=())
    across = axes.get_xlim()[1] / (WIDTH - LEFT - RIGHT)  # seconds a pixel
    for entry in segments:
        start, stop = entry.start / FPS, entry.stop / FPS
        words = str(entry.object) if entry.kind == "object" else f"itself ({entry.anchor})"
        (bar,) = axes.barh(0.5, stop - start, 0.9, start, color=FOLLOWS[entry.kind], edgecolor="white", zorder=2)
        drawing.add_tip(bar, f"{words}, {start:.1f} to {stop:.1f} s")
        if 7.0 * len(words) * across < stop - start:
            axes.text(start + 5 * across, 0.5, words, ha="left", va="center", fontsize=11, color=drawing.INK, zorder=3)


def write_timeline(demonstration: Demonstration, path: Path) -> None:
    """Write the figure, as an SVG where the path ends in ``.svg``, as a PNG elsewhere."""
    drawing.save(draw_timeline(demonstration), path)
