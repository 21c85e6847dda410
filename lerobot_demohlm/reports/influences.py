"""Where episodes began, what their worlds were like, and which succeeded -> the numbers that success depends on.

Each number of the initial states, conditions of the world among them, cuts the episodes into thirds: those where it is
lowest, those between, and those where it is highest. Thirds that succeed more or less often than chance explains tell
what to look at first.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup

from gym_demohlm.variation.conditions import SEED
from gym_demohlm.variation.factors import FACTORS
from lerobot_demohlm.drawing import rate_colour

LEAST_EXPECTED = 5  # successes and failures a third, below which a chi-squared test says nothing
LARGEST_P = 0.05
MOST_LISTED = 8
THIRDS = ("lowest third", "middle third", "highest third")
START_NAMES: Mapping[str, tuple[str, ...]] = {
    "robot": ("robot x [m]", "robot y [m]", "robot yaw [deg]"),
    "object": ("object dy [m]", "object dz [m]", "object dyaw [deg]"),
    "object_x": ("object dx [m]",),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Influence:
    """A number that success depends on.

    Attributes:
        name: Of the number, with its unit.
        values: (N,) of the episodes, in that unit.
        thirds: (N,) 0, 1 or 2: in which third an episode is.
        success: (N,) bool.
        p: Chance of differences as large where success depends on none of the numbers that were looked at.
    """

    name: str
    values: np.ndarray
    thirds: np.ndarray
    success: np.ndarray
    p: float

    def ends(self, third: int) -> tuple[float, float]:
        """Return the least and the largest value in a third."""
        own = self.values[self.thirds == third]
        return float(own.min()), float(own.max())


def influences(states: Sequence[Mapping[str, Sequence[float]]], success: np.ndarray) -> list[Influence] | None:
    """Return the numbers that success depends on, the surest first; None where there are too few episodes to tell.

    Pearson's chi-squared test on the thirds of each number, with 2 degrees of freedom; Holm's method makes up for how
    many numbers are looked at (Scandinavian Journal of Statistics 6, 1979).

    Args:
        states: N initial states with their conditions; what not all of them have is left out.
        success: (N,) bool.
    """
    rate = float(success.mean()) if len(success) else 0.0
    if len(success) * min(rate, 1.0 - rate) < LEAST_EXPECTED * len(THIRDS):
        return None
    found: list[Influence] = []
    for name, values in _numbers(states).items():
        thirds = np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values)
        counts = np.bincount(thirds, minlength=len(THIRDS))
        expected = counts * rate
        if np.minimum(expected, counts - expected).min() < LEAST_EXPECTED:
            continue  # one with few values, such as one that does not vary
        seen = np.bincount(thirds[success], minlength=len(THIRDS))
        squares = (seen - expected) ** 2 * (1.0 / expected + 1.0 / (counts - expected))
        found.append(
            Influence(name=name, values=values, thirds=thirds, success=success, p=math.exp(-0.5 * float(squares.sum())))
        )
    found.sort(key=lambda entry: entry.p)
    sure, largest = [], 0.0
    for index, entry in enumerate(found):
        largest = max(largest, min(1.0, (len(found) - index) * entry.p))
        if largest > LARGEST_P:
            break
        sure.append(replace(entry, p=largest))
    return sure


def together(first: Influence, second: Influence) -> np.ndarray:
    """Return (3, 3, 2) counts of successes and of all episodes, by the thirds of two numbers."""
    counts = np.zeros((len(THIRDS), len(THIRDS), 2), dtype=int)
    np.add.at(counts[..., 0], (first.thirds, second.thirds), first.success)
    np.add.at(counts[..., 1], (first.thirds, second.thirds), 1)
    return counts


def section(found: Sequence[Influence] | None) -> Markup:
    """Return what a page says about them: a table of thirds, and one of the first two numbers together."""
    if found is None:
        return Markup("<p>There are too few successes or failures to tell.</p>")
    if not found:
        return Markup("<p>These episodes do not show that success depended on any number of the initial states.</p>")
    rows = Markup("").join(_row(entry) for entry in found[:MOST_LISTED])
    table = Markup(
        '<table><tr><th>Number</th>{}<th class="number">p</th></tr>{}</table>'
        '<p class="small">Success rate and range of each third of the episodes, by one number, whatever the others. '
        "p: the chance of differences as large if success depended on no number (chi-squared test, Holm's method).</p>"
    ).format(Markup("").join(Markup("<th>{}</th>").format(name) for name in THIRDS), rows)
    return table + _grid(*found[:2]) if len(found) > 1 else table


def _row(entry: Influence) -> Markup:
    cells = []
    for third in range(len(THIRDS)):
        own = entry.success[entry.thirds == third]
        low, high = entry.ends(third)
        cells.append(_cell(int(own.sum()), len(own), f"{low:.3g} to {high:.3g}"))
    p = "below 0.0001" if entry.p < 1e-4 else f"{entry.p:.4f}"
    return Markup('<tr><td>{}</td>{}<td class="number" style="padding-left: .6rem">{}</td></tr>').format(
        entry.name, Markup("").join(cells), p
    )


def _grid(first: Influence, second: Influence) -> Markup:
    counts = together(first, second)
    head = Markup("").join(Markup("<th>{}</th>").format(name) for name in THIRDS)
    rows = Markup("").join(
        Markup("<tr><td>{}</td>{}</tr>").format(
            THIRDS[row], Markup("").join(_cell(*counts[row, column]) for column in range(len(THIRDS)))
        )
        for row in range(len(THIRDS))
    )
    return Markup("<table><tr><th>{} down, {} across</th>{}</tr>{}</table>").format(first.name, second.name, head, rows)


def _cell(successes: int, count: int, words: str = "") -> Markup:
    if not count:
        return Markup("<td></td>")
    rate = successes / count
    return Markup(
        '<td style="background: {}; padding-left: .6rem">{:.0f} % <span class="small">of {}{}</span></td>'
    ).format(rate_colour(rate), 100 * rate, count, f", {words}" if words else "")


def _numbers(states: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, np.ndarray]:
    """Return the numbers (N,) of the states by their names; angles of starts in degrees."""
    shared = [key for key in states[0] if key != SEED and all(key in state for state in states)]
    found = {}
    for key in shared:
        rows = np.array([state[key] for state in states], dtype=float)
        for name, column in zip(_names(key, rows.shape[1]), rows.T, strict=True):
            found[name] = np.degrees(column) if name.endswith("[deg]") else column
    return found


def _names(key: str, size: int) -> tuple[str, ...]:
    if "." not in key:
        return START_NAMES.get(key, (f"{key} dx [m]", f"{key} dy [m]", f"{key} dyaw [deg]"))
    unit = FACTORS[".".join(key.split(".")[:2])].unit
    suffix = "" if unit == "1" else f" [{unit}]"
    return tuple(f"{key}{f' {index + 1}' if size > 1 else ''}{suffix}" for index in range(size))
