"""Demonstrations of operators who move as people do -> how often episodes are generated from each: lines, a table.

A line stands for one operator of one task: what it took to record, and how the attempts ended. Lines that are there
already are not measured again, so a run that was killed goes on where it was.
"""

import math
import shutil
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError, DemonstrationError
from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION, Task
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.reproducibility.results import append_result
from lerobot_demohlm.teleop.perturbed import MAX_TRIES, record_perturbed
from lerobot_demohlm.teleop.trial import TrialSettings

COMMAND = "demohlm benchmark perturbed"
GOOD = 0.95  # share of attempts that succeed with a demonstration that one can work with
TOGETHER = 10
AGED = " *"  # behind a task that has changed since
SEED = 980_000  # of the attempts' starts; not one that datasets or trials use


@dataclass(frozen=True, kw_only=True)
class PerturbedLine:
    """What one operator's demonstration of one task gave.

    Attributes:
        task: Name of the task.
        operator: Seed of the operator.
        region: Where attempts start.
        attempts: Asked for; none are made where there is no demonstration.
        successes: Of these.
        trial: Attempts of the trial that the operator looks at before saving, with other starts.
        tries: Recordings until one succeeded whose trial was good.
        failed: How many of them did not succeed; the others had a bad trial.
        steps: Length of the demonstration, in steps of 0.1 s.
        delay_ms: Of the operator [ms].
        reasons: Why attempts failed, each with how many did.
        refusal: Why there is no demonstration; empty where there is one.
        stamp: Of the task, see ``portability.stamp``.
        recording: Of the demonstration: the first digits of its content hash.
    """

    task: str
    operator: int
    region: str
    attempts: int
    successes: int
    trial: int
    tries: int
    failed: int
    steps: int
    delay_ms: float
    reasons: list[Any]
    refusal: str
    stamp: str
    recording: str

    @property
    def good(self) -> bool:
        """Whether one can work with it."""
        return not self.refusal and self.successes >= GOOD * self.attempts


def measure(
    tasks: Sequence[Task],
    operators: Iterable[int],
    attempts: int,
    append: Path,
    root: Path,
    region: str = DEFAULT_REGION,
    trial: int = TrialSettings().attempts,
) -> Iterator[PerturbedLine]:
    """Measure what is not in a file yet, append it there, and yield every line asked for.

    Args:
        tasks: The tasks.
        operators: Seeds of the operators, the same for all tasks.
        attempts: Attempts from each demonstration.
        append: The file of lines.
        root: Folder for the demonstrations; those of earlier runs are removed.
        region: Where attempts start.
        trial: Attempts of the trial before a demonstration is saved; an operator whose trial succeeds less often than
            ``GOOD`` records again.

    Raises:
        DatasetError: ``attempts`` is less than 1.
    """
    if attempts < 1:
        raise DatasetError(f"attempts={attempts}", "1 or more", "correct --num-attempts")
    known = {_key(line): line for line in read(append)} if append.exists() else {}
    for operator in operators:
        for task in tasks:
            key = (task.name, operator, region, attempts, trial, portability.stamp(task))
            line = known.get(key)
            if line is None:
                values = _measure(task, operator, attempts, root / f"{task.slug}_{operator}", region, trial)
                call = f"{COMMAND} --tasks {task.name} --first {operator} --num-operators 1"
                append_result(append, f"{call} --num-attempts {attempts} --num-trial {trial}", values)
                line = jsonl.parse(PerturbedLine, values, str(append))
            yield line


def _key(line: PerturbedLine) -> tuple[Any, ...]:
    return (line.task, line.operator, line.region, line.attempts, line.trial, line.stamp)


def _measure(task: Task, operator: int, count: int, root: Path, region: str, trial: int) -> dict[str, Any]:
    shutil.rmtree(root, ignore_errors=True)
    root.parent.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    bad_trials: list[str] = []

    def judge(recording: Demonstration) -> str:
        """Stop as soon as too many have failed."""
        allowed, failures = trial - math.ceil(GOOD * trial), 0
        for first in range(0, trial, TOGETHER):
            episodes = _attempts(
                task, recording, region, TrialSettings().seed, range(first, min(trial, first + TOGETHER))
            )
            failures += sum(episode.outcome != "success" for episode in episodes)
            if failures > allowed:
                bad_trials.append(f"{failures} of {first + len(episodes)} attempts of the trial failed")
                return bad_trials[-1]
        return ""

    values: dict[str, Any] = {"task": task.name, "operator": operator, "region": region, "attempts": count}
    values |= {"trial": trial, "successes": 0, "stamp": portability.stamp(task), "reasons": [], "refusal": ""}
    try:
        recorded = record_perturbed(task, operator, root, judge)
    except DemonstrationError as error:
        values |= {"tries": MAX_TRIES, "failed": MAX_TRIES - len(bad_trials), "steps": 0, "delay_ms": 0.0}
        return values | {"recording": "", "refusal": str(error), "seconds": round(time.perf_counter() - began, 1)}
    episodes = _attempts(task, recorded.demonstration, region, SEED, range(count))
    failed = Counter(f"{e.outcome}: {e.reason.partition(' (')[0]}" for e in episodes if e.outcome != "success")
    return values | {
        "successes": sum(episode.outcome == "success" for episode in episodes),
        "tries": recorded.tries,
        "failed": recorded.tries - 1 - len(bad_trials),
        "steps": len(recorded.demonstration),
        "delay_ms": round(1e3 * recorded.person.delay_s, 1),
        "reasons": [list(entry) for entry in failed.most_common()],
        "recording": recorded.demonstration.content_hash[:12],
        "seconds": round(time.perf_counter() - began, 1),
    }


def _attempts(task: Task, demonstration: Demonstration, region: str, seed: int, indices: range) -> list[Episode]:
    made = Attempts(task, demonstration, region, seed, num_worlds=min(TOGETHER, len(indices)))
    try:
        return made.run(indices)
    finally:
        made.close()


def read(path: Path) -> list[PerturbedLine]:
    """Return the lines of a file, of several measurements of the same the last one."""
    last: dict[tuple[Any, ...], PerturbedLine] = {}
    for line in jsonl.read_as(PerturbedLine, path):
        last[_key(line)] = line
    return list(last.values())


def table(lines: Sequence[PerturbedLine], tasks: Sequence[str]) -> str:
    """Return lines as a Markdown table with a row for each of some tasks, with the trial of its last line.

    An operator none of whose recordings was good enough is counted as such; other columns are of the demonstrations.
    Of two lines of one operator the later one counts: the task has changed since the earlier one. A task has a star
    where it has changed since one of its lines.
    """
    counts = "operators | none good enough | with 95 % or more | attempts | success [%] | lowest [%]"
    rows = [f"| task | trial | {counts} | recordings | of these failed |", "|" + "---|" * 10]
    for task in tasks:
        own = [line for line in lines if line.task == task]
        if not own:
            continue
        kind = (own[-1].trial, own[-1].region, own[-1].attempts)
        newest = {line.operator: line for line in own if (line.trial, line.region, line.attempts) == kind}
        asked = list(newest.values())
        found = [line for line in asked if not line.refusal]
        aged = any(line.stamp != portability.stamp(get_task(task)) for line in asked)
        name = f"{task}{AGED if aged else ''} | {own[-1].trial}"
        if not found:
            rows.append(f"| {name} | {len(asked)} | {len(asked)} | 0 | 0 | - | - | - | - |")
            continue
        attempts, successes = (sum(getattr(line, name) for line in found) for name in ("attempts", "successes"))
        lowest = min(line.successes / line.attempts for line in found)
        tries, without = (sum(getattr(line, name) for line in found) for name in ("tries", "failed"))
        rows.append(
            f"| {name} | {len(asked)} | {len(asked) - len(found)} | {sum(line.good for line in found)} "
            f"| {attempts} | {100 * successes / attempts:.1f} | {100 * lowest:.0f} | {tries} | {without} |"
        )
    return "\n".join(rows)
