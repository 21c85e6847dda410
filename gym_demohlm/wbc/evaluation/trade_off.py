"""Shares of the command range and loads -> what the controller keeps of accuracy and balance: a table, a figure.

``demohlm benchmark controller --trade-off docs`` measures and draws it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from gym_demohlm.wbc.evaluation.episodes import measure, summarise
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_simulation
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

matplotlib.use("Agg")

SHARES = (0.25, 0.5, 0.75, 1.0)
HAND_LOADS = (0.0, 1.0, 2.0)  # kg in each hand
_PANELS = {  # quantity -> axis label, factor, what is asked of the whole range
    "walking/linear_velocity": ("velocity error, walking [m/s]", 1.0, 0.105),
    "walking/yaw_rate": ("yaw rate error, walking [rad/s]", 1.0, 0.16),
    "survival": ("no fall in an episode [%]", 100.0, 99.0),
    "standing/torso_pitch": ("torso pitch error, standing [rad]", 1.0, 0.037),
    "standing/torso_roll": ("torso roll error, standing [rad]", 1.0, 0.020),
    "standing/height": ("height error, standing [m]", 1.0, 0.011),
}
_COLORS = ("#00798c", "#edae49", "#d1495b")


def trade_off(
    num_worlds: int,
    seconds: float,
    seed: int,
    num_threads: int = 2,
    weights: Path | None = None,
    *,
    shares: Sequence[float] = SHARES,
    hand_loads: Sequence[float] = HAND_LOADS,
) -> dict[str, Any]:
    """Return errors by mode and survival, for each load a list over the shares of the command range.

    Args:
        num_worlds: Robots for each point, one episode each.
        seconds: Length of an episode.
        seed: Of commands.
        num_threads: Threads of the physics.
        weights: Of the controller; the packaged ones by default.
        shares: Of the whole command range, about the robot at rest.
        hand_loads: In each hand [kg].
    """
    points = []
    for load in hand_loads:
        simulation = trial_simulation(
            num_worlds, Disturbance(hand_loads=(load, load)), num_threads=num_threads, weights=weights
        )
        for share in shares:
            samples = measure(simulation, seconds, seed, ranges=CommandRange().scaled(share))
            points.append({"hand_load": load, "share": share, **summarise([samples])})
        simulation.close()
    return {"points": points, "num_worlds": num_worlds, "seconds": seconds, "seed": seed}


def draw_trade_off(found: dict[str, Any], path: Path) -> None:
    """Draw what ``trade_off`` found, a panel a quantity; dotted lines are what is asked of the whole range."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True)
    loads = dict.fromkeys(point["hand_load"] for point in found["points"])
    for axes, (name, (label, factor, asked)) in zip(panels.flat, _PANELS.items(), strict=True):
        for load, color in zip(loads, _COLORS, strict=False):
            points = [point for point in found["points"] if point["hand_load"] == load]
            shares = 100 * np.array([point["share"] for point in points])
            values = factor * np.array([point[name] for point in points])
            axes.plot(shares, values, "o-", color=color, markersize=4, linewidth=1.3, label=f"{load:g} kg in each hand")
        axes.axhline(asked, color="0.4", linewidth=0.9, linestyle=":")
        axes.set_ylabel(label, fontsize=9)
        if name != "survival":
            axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    for axes in panels[1]:
        axes.set_xlabel("share of the command range [%]")
    panels[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=100)
