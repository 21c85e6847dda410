"""Lines of results -> those that count, their rates with intervals, how old they are, and the texts of cells."""

from collections.abc import Callable, Iterable, Sequence
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, Protocol

import numpy as np

from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.experiments.lines import GenerationResult, Measurement, PolicyResult
from lerobot_demohlm.experiments.variants import DEFAULT_VARIANT, stamp
from lerobot_demohlm.policies.presets import get_preset

RESAMPLES = 10_000
EARLIER = ", an earlier version"
PARTLY_EARLIER = ", in part an earlier version"
TITLES = {"mlp": "MLP", "act": "ACT", "diffusion": "Diffusion"}

Shown = tuple[str, str]
"""The text of a cell, and what stands behind it when what it shows is of an earlier version."""

NOTHING: Shown = ("-", "")


class Stamped(Protocol):
    """A result of a task, with the digest of what generation did with the task when it was measured."""

    @property
    def task(self) -> str:
        """Name of the task."""
        ...

    @property
    def stamp(self) -> str | None:
        """Digest of what generation did with the task in its worlds; None where it was not written down."""
        ...

    @property
    def stamp_now(self) -> str:
        """The same of today."""
        ...


def rate(lines: Sequence[PolicyResult]) -> tuple[float, float, float]:
    """Return the success rate of one cell of a table and its 95 % interval, in [0, 1].

    One training: Wilson's interval over its rollouts. Several: see ``mean_rate``.

    Args:
        lines: One a training seed.
    """
    if len(lines) > 1:
        return mean_rate([lines])
    successes, episodes = lines[0].successes, lines[0].episodes
    return successes / episodes, *wilson(successes, episodes)


def mean_rate(cells: Sequence[Sequence[PolicyResult]]) -> tuple[float, float, float]:
    """Return the mean success rate of several cells and its 95 % interval, in [0, 1].

    A bootstrap draws trainings of each cell and, for each, a rate that its rollouts allow (Jeffreys' posterior, which
    does not vanish at 0 and 1).

    Args:
        cells: Their lines, one a training seed.
    """
    rng = np.random.default_rng(0)
    means, drawn_means = [], []
    for lines in cells:
        counts = np.array([[line.successes, line.episodes] for line in lines])  # (trainings, 2)
        means.append((counts[:, 0] / counts[:, 1]).mean())
        drawn = rng.integers(len(lines), size=(RESAMPLES, len(lines)))
        successes, failures = counts[drawn, 0], counts[drawn, 1] - counts[drawn, 0]
        drawn_means.append(rng.beta(successes + 0.5, failures + 0.5).mean(axis=1))
    mean = float(np.mean(means))
    low, high = np.quantile(np.mean(drawn_means, axis=0), (0.025, 0.975)).tolist()
    return mean, min(mean, low), max(mean, high)


def latest(lines: Iterable[PolicyResult], *, any_steps: bool = False) -> list[PolicyResult]:
    """Keep the last line of each training seed of each cell, of those that were made as the cell's last line was.

    That is by what generation does, by hyperparameters and from the first start.

    Args:
        lines: Of any cells.
        any_steps: Take trainings of different numbers of steps for different cells. Otherwise those of as many as the
            preset has are kept, where there are any of any version.
    """
    keys = ("task", "policy", "preset", "num_train_episodes", "region", "variant", "variation", "perception")
    keys += ("steps",) if any_steps else ()
    kept = []
    for found in group(lines, *keys).values():
        usual = [line for line in found if not steps_title(line)] or found
        kept += {line.train_seed: line for line in usual if _made_by(line) == _made_by(usual[-1])}.values()
    return kept


def _made_by(line: PolicyResult) -> tuple[str | None, str | None, int | None]:
    return line.stamp, line.recipe, line.first_seed


def of_the_paper(lines: Iterable[PolicyResult]) -> list[PolicyResult]:
    """Keep of these what the paper's tables are of: policies of the usual data in plain worlds, seen exactly."""
    return [line for line in latest(lines) if line.is_plain and line.variant == DEFAULT_VARIANT]


def age(line: Stamped) -> str:
    """Return what stands behind a result when what its task's data is made by has changed since, else nothing."""
    return "" if line.stamp == line.stamp_now else EARLIER


def measured_age(line: Measurement) -> str:
    """Return what stands behind a measurement whose task generation has changed since, or may have, else nothing."""
    return "" if line.get("stamp") == stamp(line["task"]) else EARLIER


def age_of(lines: Sequence[Stamped]) -> str:
    """Return what stands behind what several results are shown in, by how many of them are of an earlier version."""
    return common_age([age(line) for line in lines])


def common_age(ages: Sequence[str]) -> str:
    """Return what stands behind what is shown of several things by what stands behind each; nothing for none."""
    return PARTLY_EARLIER if len(set(ages)) > 1 else max(ages, default="")


def group(lines: Iterable[PolicyResult], *keys: str) -> dict[tuple[Any, ...], list[PolicyResult]]:
    """Collect lines that agree in some keys, sorted by them."""
    groups: dict[tuple[Any, ...], list[PolicyResult]] = {}
    for line in lines:
        groups.setdefault(tuple(getattr(line, key) for key in keys), []).append(line)
    return dict(sorted(groups.items()))


def percent(lines: Sequence[PolicyResult] | None) -> str:
    """Return a rate with its interval, and how many trainings are behind it where it is not one."""
    if not lines:
        return "-"
    text = interval(*rate(lines)) + strictly(strict_rate(lines))
    return text if len(lines) == 1 else f"{text}, {len(lines)} seeds"


def strict_rate(lines: Sequence[PolicyResult]) -> float | None:
    """Return the mean rate of strict successes of one cell, in [0, 1]; None where one of its lines does not know it."""
    rates = [line.successes_strict / line.episodes for line in lines if line.successes_strict is not None]
    return float(np.mean(rates)) if rates and len(rates) == len(lines) else None


def strictly(rate: float | None) -> str:
    """Return what stands beside the rate of held successes: that of strict ones, where it was judged."""
    return "" if rate is None else f", strict {100 * rate:.1f}"


def generated(line: GenerationResult) -> str:
    """Return the success rate of a line of generation with its interval, that of strict ones, and of first tries."""
    text = share(line.successes, line.attempts) + strictly(line.strict_rate)
    if line.first_try_successes is None or line.first_try_successes == line.successes:
        return text
    return f"{text}, at the first try {100 * line.first_try_successes / line.attempts:.1f}"


def interval(mean: float, low: float, high: float) -> str:
    """Return a rate with its interval."""
    return f"{100 * mean:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def share(successes: int, trials: int) -> str:
    """Return a rate with Wilson's interval."""
    return interval(successes / trials, *wilson(successes, trials))


def number(value: float | None) -> str:
    """Return a percentage, 13.35 as 13.4: the paper's have two digits, and are not to look smaller than they are."""
    return "-" if value is None else str(Decimal(str(value)).quantize(Decimal("0.1"), ROUND_HALF_UP))


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def cell(lines: Sequence[PolicyResult] | None, show: Callable[[Sequence[PolicyResult]], str] = percent) -> Shown:
    """Return what is shown of a cell's lines, and what of their age."""
    return (show(lines), age_of(lines)) if lines else NOTHING


def marked(label: str, cells: Sequence[Shown]) -> list[str]:
    """Return a row: its label and its cells; the label says it where all of them are of an earlier version."""
    ages = {aged for text, aged in cells if text != "-"}
    common = ages.pop() if len(ages) == 1 else ""
    return [label + common, *(text + ("" if aged == common else aged) for text, aged in cells)]


def method_title(policy: str, preset: str, device: str = "cpu") -> str:
    """Return what a table calls a policy of a preset that was trained on a device."""
    return TITLES[policy] + ("" if preset == "cpu" else f" ({preset})") + trained_on(device)


def steps_title(line: PolicyResult) -> str:
    """Return what a table says of the training steps of a line: nothing where they are the preset's."""
    return "" if line.steps == get_preset(line.policy, line.preset).steps else f", {line.steps} steps"


def trained_on(device: str) -> str:
    """Return what a table says of where a policy was trained: nothing where that was the CPU."""
    return "" if device == "cpu" else f", trained on {device}"
