"""Tasks and variations -> how often generation succeeds in worlds that vary, and what fails: lines, a table.

A line stands for the attempts of one task under one variation. The attempts of a task start at the same places under
all of them, so columns differ by the worlds alone. Lines that are there already are not measured again.
"""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION, Task
from gym_demohlm.variation.factors import FACTORS, GROUPS
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility.results import append_result

SEED = 970_000  # of the attempts' starts; not one that datasets, trials or other probes use
_VARIED = tuple(group for group in GROUPS if any(factor.group == group for factor in FACTORS.values()))
PROBES = ("none", "real", *(f"real:{group}" for group in _VARIED))
TOGETHER = 16


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What became of the attempts of one task under one variation.

    Attributes:
        task: Name of the task.
        variation: Name of the variation.
        region: Where attempts start.
        attempts: How many.
        successes: Of these, by the paper's condition held for a second.
        strict: Of these, by the strict judge.
        reasons: Why attempts failed, each with how many did.
        stamp: Of the task, see ``portability.stamp``.
        cpu_ms_step: Processor time of a world's step [ms].
    """

    task: str
    variation: str
    region: str
    attempts: int
    successes: int
    strict: int
    reasons: list[Any]
    stamp: str
    cpu_ms_step: float


def measure(
    tasks: Sequence[Task],
    variations: Iterable[str],
    attempts: int,
    path: Path,
    region: str = DEFAULT_REGION,
) -> Iterator[Probe]:
    """Measure what is not in a file yet, append it there, and yield every probe asked for.

    Args:
        tasks: The tasks.
        variations: Names of the variations.
        attempts: Of each probe.
        path: The file of lines.
        region: Where attempts start.

    Raises:
        DatasetError: ``attempts`` is less than 1.
        UnknownNameError: No such variation or region.
    """
    if attempts < 1:
        raise DatasetError(f"attempts={attempts}", "1 or more", "correct --num-attempts")
    known = {_key(probe): probe for probe in jsonl.read_as(Probe, path)} if path.exists() else {}
    for variation in variations:
        for task in tasks:
            probe = known.get((task.name, variation, region, attempts, portability.stamp(task)))
            if probe is None:
                values = _measure(task, variation, attempts, region)
                call = f"demohlm benchmark variation --tasks {task.name} --variations {variation}"
                append_result(path, f"{call} --num-attempts {attempts} --region {region}", values)
                probe = jsonl.parse(Probe, values, str(path))
            yield probe


def _key(probe: Probe) -> tuple[Any, ...]:
    return probe.task, probe.variation, probe.region, probe.attempts, probe.stamp


def _measure(task: Task, variation: str, count: int, region: str) -> dict[str, Any]:
    settings = Settings(variation=replace(PLAIN, variation=variation))
    source = demonstrations.load(None, task)
    made = Attempts(task, source, region, SEED, num_worlds=min(TOGETHER, count), settings=settings)
    began = time.process_time()
    episodes = made.run(range(count))
    spent = time.process_time() - began
    made.close()
    failed = Counter(f"{e.outcome}: {e.reason.partition(' (')[0]}" for e in episodes if e.outcome != "success")
    return {
        "task": task.name,
        "variation": variation,
        "region": region,
        "seed": SEED,
        "attempts": count,
        "successes": sum(episode.outcome == "success" for episode in episodes),
        "strict": sum(episode.success_strict for episode in episodes),
        "reasons": [list(entry) for entry in failed.most_common()],
        "stamp": portability.stamp(task),
        "cpu_ms_step": round(1000 * spent / sum(len(episode.success) for episode in episodes), 2),
    }


def table(probes: Sequence[Probe]) -> str:
    """Return a Markdown table of tasks against variations, with the successes [%] of each, paper's and strict."""
    variations = list(dict.fromkeys(probe.variation for probe in probes))
    rows = [f"| task | {' | '.join(variations)} |", "|" + "---|" * (len(variations) + 1)]
    for task in dict.fromkeys(probe.task for probe in probes):
        found = {probe.variation: probe for probe in probes if probe.task == task}
        rows.append(f"| {task} | {' | '.join(_cell(found.get(name)) for name in variations)} |")
    return "\n".join(rows)


def _cell(probe: Probe | None) -> str:
    if probe is None:
        return "-"
    return " / ".join(f"{100 * count / probe.attempts:.0f}" for count in (probe.successes, probe.strict))
