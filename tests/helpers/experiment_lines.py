"""Lines of experiments that nobody ran."""

import dataclasses
from pathlib import Path
from typing import Any

from lerobot_demohlm.experiments.layout import Layout
from lerobot_demohlm.experiments.lines import PolicyResult
from lerobot_demohlm.experiments.plan import Cell

CELL = Cell(task="LiftBox", policy="mlp", preset="cpu", num_train_episodes=100, train_seed=0, steps=8000)


def make_line(cell: Cell = CELL, successes: int = 200, **changes: Any) -> PolicyResult:
    """Return the result of a cell with 250 rollouts."""
    counts = {"episodes": 250, "successes": successes, "successes_end": successes, "successes_ever": successes}
    outcomes = {"success": successes, "fell": 250 - successes}
    times = {"train_s": 600.0, "train_samples_per_s": 5000, "rollouts_per_hour": 2000}
    own = {
        "stamp": cell.stamp,
        "first_seed": cell.first_seed,
        "recipe": cell.recipe,
        "policy_hash": "0" * 64,
        "outcomes": outcomes,
    }
    return PolicyResult(**(dataclasses.asdict(cell) | own | counts | times | changes))


def layout(root: Path) -> Layout:
    """Return where experiments under a directory of a test are."""
    return Layout(root=root / "runs", results=root / "results")
