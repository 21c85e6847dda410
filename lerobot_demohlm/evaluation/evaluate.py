"""Rollouts of a policy -> one JSON line an episode, resumed where they were killed, and rates with Wilson intervals."""

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation.judge import OUTCOMES
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.evaluation.rollouts import OnStep, Setting, roll_batches
from lerobot_demohlm.reproducibility import provenance

FIRST_SEED = 1_000_000
"""Rollouts draw their starts from this seed on. Generation draws from (seed, attempt) pairs: of the starts of
rollouts only that of seed 0 is one of them, the first one of seed 0."""
MAX_SEED = 2**63 - 1
SUCCESSES = ("success_strict", "success_held", "success_end", "success_ever")


def evaluate(
    loaded: LoadedPolicy,
    setting: Setting,
    seeds: Sequence[int],
    output: Path,
    *,
    deadline: float = math.inf,
    on_step: OnStep | None = None,
) -> list[Rollout]:
    """Roll out and append one JSON line an episode to a file; a call that was killed is resumed by the same call.

    A batch with a missing line is rolled out anew as a whole, so a policy that draws random numbers gives the lines
    that it would have given without the interruption.

    Args:
        loaded: The policy.
        setting: Task, region and how many at a time.
        seeds: One an episode.
        output: The file; made where it does not exist.
        deadline: Begin no batch after this time (``time.monotonic``) [s].
        on_step: See ``OnStep``; with one worker only.

    Returns:
        The rollouts in the file that have these seeds, in the order of the seeds; fewer where the deadline came first.

    Raises:
        DatasetError: The file holds rollouts of something else.
    """
    from tqdm import tqdm

    task = get_task(setting.task)
    header = {
        "task": task.name,
        "region": setting.region,
        "perception": setting.perception,
        "variation": setting.variation,
        "policy": loaded.kind,
        "policy_hash": loaded.hash,
        "controller": provenance.controller_hash(setting.controller),
        "code": provenance.simulation_hash(task),
    }
    setting = setting.limited(len(seeds))  # of all seeds, so that a resumed batch is as wide as it was
    found = {rollout.seed: rollout for rollout in resumed_rollouts(output, header)}
    jsonl.append(output, [])  # a file that cannot be written is found before the first rollout
    pending = [batch for batch in setting.batches(seeds) if not found.keys() >= set(batch)]
    with tqdm(total=len(seeds), initial=sum(seed in found for seed in seeds), desc="rollouts", unit="episode") as bar:
        for batch in _until(deadline, roll_batches(loaded, setting, pending, on_step=on_step)):
            new = [rollout for rollout in batch if rollout.seed not in found]
            jsonl.append(output, map(asdict, new))
            found |= {rollout.seed: rollout for rollout in new}
            bar.update(len(new))
    return [found[seed] for seed in seeds if seed in found]


def _until(deadline: float, batches: Iterator[list[Rollout]]) -> Iterator[list[Rollout]]:
    """Yield batches until the deadline has passed."""
    while time.monotonic() < deadline:
        batch = next(batches, None)
        if batch is None:
            return
        yield batch


def wilson(successes: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the Wilson score interval of a rate, 95 % by default.

    Args:
        successes: How many.
        count: Of how many, at least 1.
        z: Quantile of the normal distribution.
    """
    if not 0 <= successes <= count or count < 1:
        raise ValueError(f"got {successes} successes of {count}; expected 0 to {count}, of 1 or more; count again")
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))  # min and max: rounding at 0 and 1


def success_rate(successes: int, count: int) -> dict[str, Any]:
    """Return the share of successes and its Wilson interval, as files and tables have them."""
    low, high = wilson(successes, count)
    return {"rate": round(successes / count, 4), "interval": [round(low, 4), round(high, 4)]}


def summarize(rollouts: Sequence[Rollout]) -> dict[str, Any]:
    """Return the success rates of rollouts with their intervals, and the count of each outcome."""
    content: dict[str, Any] = {"episodes": len(rollouts)}
    for name in SUCCESSES:
        if any(getattr(rollout, name) is None for rollout in rollouts):
            continue  # of a version that did not judge it
        successes = sum(getattr(rollout, name) for rollout in rollouts)
        content[name] = success_rate(successes, len(rollouts))
    counts = Counter(rollout.outcome for rollout in rollouts)
    return content | {"outcomes": {outcome: counts[outcome] for outcome in OUTCOMES}}


def resumed_rollouts(path: Path, header: Mapping[str, Any]) -> list[Rollout]:
    """Return the rollouts that a killed evaluation left, none where there is no file; a torn last line is cut off.

    Args:
        path: The file.
        header: What every rollout must say, by field.

    Raises:
        DatasetError: A rollout says something else, or the file holds something else, which is left as it is.
    """
    if not path.exists():
        return []
    rollouts = jsonl.resume(Rollout, path)
    for rollout in rollouts:
        for key, value in header.items():
            if getattr(rollout, key) != value:
                raise DatasetError(
                    f"{path} with rollouts of {key}={getattr(rollout, key)}",
                    f"{key}={value}",
                    "move this file away, or choose another --output where there is one",
                )
    return rollouts


def read_rollouts(path: Path) -> list[Rollout]:
    """Return the rollouts of a file of ``demohlm evaluate``.

    Raises:
        DatasetError: There is no such file, it holds something else, or nothing.
    """
    rollouts = jsonl.read_as(Rollout, path)
    if not rollouts:
        raise DatasetError(f"{path} without rollouts", "a file of `demohlm evaluate`", "check the path")
    return rollouts
