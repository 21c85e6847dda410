"""What two controllers made of the same commands -> by how much they differ, with intervals of a paired bootstrap.

Robot i of both has the same loads, commands and pushes. Robots are drawn again with replacement, both of a pair
together, and each mean is taken over the samples of the robots that were drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm.wbc.evaluation.episodes import LIGHT_ROWS, PLAIN_ROWS, Samples, Trials

HIGHER_IS_BETTER = ("survival", "survival_pushed")
ACCEPTED = (
    "linear_velocity_error",
    "yaw_rate_error",
    "linear_velocity_error_cycle",
    "yaw_rate_error_cycle",
    "height_error",
    "torso_pitch_error",
    "torso_roll_error",
    "torso_yaw_error",
    "walking_power_velocity_only",
    "walking_slip_velocity_only",
    *HIGHER_IS_BETTER,
)
"""Numbers in which a new default controller must not be worse."""
_DRAWS = 2000


@dataclass(frozen=True, kw_only=True)
class Row:
    """One number of two controllers.

    Attributes:
        name: Of a number of ``Trials.rows``.
        new: Of the new controller.
        old: Of the old one.
        low: Lower end of the 95 % interval of new - old.
        high: Its upper end.
    """

    name: str
    new: float
    old: float
    low: float
    high: float

    @property
    def worse(self) -> bool:
        """Whether the new controller is worse, beyond the interval."""
        return self.high < 0.0 if self.name in HIGHER_IS_BETTER else self.low > 0.0


def compare(new: Trials, old: Trials, seed: int = 0, rows: Sequence[str] = ACCEPTED) -> list[Row]:
    """Compare two controllers that were tried with the same arguments.

    Args:
        new: Of one.
        old: Of the other.
        seed: Of the bootstrap.
        rows: What is compared, names of ``Trials.rows``.

    Returns:
        One row for each of ``rows``.
    """
    rng, found = np.random.default_rng(seed), []
    for name in rows:
        pair = [_sums(trials, name) for trials in (new, old)]
        robots = pair[0].shape[1]
        drawn = rng.multinomial(robots, np.full(robots, 1 / robots), _DRAWS)
        means = [_mean(drawn @ sums.T) for sums in pair]
        low, high = _interval(means[0] - means[1])
        whole = [float(_mean(sums.sum(axis=1)[None])[0]) for sums in pair]
        found.append(Row(name=name, new=whole[0], old=whole[1], low=low, high=high))
    return found


def _sums(trials: Trials, row: str) -> np.ndarray:
    """Return sum and number of the samples of each robot, (2, N)."""
    if row in HIGHER_IS_BETTER:
        groups = trials.pushed if row == "survival_pushed" else trials.plain
        alive = np.concatenate([group.alive for group in groups]).astype(float)
        return np.stack([alive, np.ones_like(alive)])
    light = row.endswith("_velocity_only")
    name = LIGHT_ROWS[row.removesuffix("_velocity_only")] if light else PLAIN_ROWS[row]
    return _joined(trials.light if light else trials.plain, name)


def _joined(groups: Sequence[Samples], name: str) -> np.ndarray:
    empty = (np.zeros((2, len(group.alive))) for group in groups)
    return np.concatenate([group.sums.get(name, none) for group, none in zip(groups, empty, strict=True)], axis=1)


def _interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of draws (n,); NaN where no draw has a value."""
    known = values[~np.isnan(values)]
    low, high = np.quantile(known, (0.025, 0.975)) if len(known) else (np.nan, np.nan)
    return float(low), float(high)


def _mean(sums: np.ndarray) -> np.ndarray:
    """Return sums divided by their numbers, (n, 2) -> (n,); NaN where there is none."""
    return np.divide(sums[:, 0], sums[:, 1], out=np.full(len(sums), np.nan), where=sums[:, 1] > 0)
