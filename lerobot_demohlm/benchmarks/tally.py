"""A task, settings and a seed -> how many attempts at it succeed, and why the others do not."""

import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

from gym_demohlm.task import Task
from lerobot_demohlm.checks import portability
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.stages import Settings

TOGETHER = 16  # attempts side by side


@dataclass(frozen=True, kw_only=True)
class Tally:
    """What became of attempts at one task.

    Attributes:
        task: Name of the task.
        variation: Name of the variation.
        region: Where attempts start.
        attempts: How many.
        successes: Of these, by the paper's condition held for a second.
        strict: Of these, by the strict judge.
        reasons: Why attempts failed, each with how many did.
        stamp: Of the task, see ``portability.stamp``.
        worlds: Of these worlds, see ``portability.worlds_stamp``; lines from before there was one have none.
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
    worlds: str = ""
    cpu_ms_step: float

    @property
    def made_of(self) -> tuple[str, str, str, int, str, str]:
        """What a line must agree in to stand for another measurement."""
        return self.task, self.variation, self.region, self.attempts, self.stamp, self.worlds


def tally(task: Task, settings: Settings, region: str, seed: int, count: int) -> dict[str, Any]:
    """Make attempts from the packaged demonstration and return a ``Tally`` as a line has it, without its stamps.

    Args:
        task: The task.
        settings: Of the attempts.
        region: Where they start.
        seed: Of their starts.
        count: How many.
    """
    made = Attempts(task, demonstrations.load(None, task), region, seed, min(TOGETHER, count), settings)
    began = time.process_time()
    try:
        episodes = made.run(range(count))
    finally:
        made.close()
    spent = time.process_time() - began
    failed = Counter(f"{e.outcome}: {e.reason.partition(' (')[0]}" for e in episodes if e.outcome != "success")
    return {
        "task": task.name,
        "variation": settings.variation.variation,
        "region": region,
        "seed": seed,
        "attempts": count,
        "successes": sum(episode.outcome == "success" for episode in episodes),
        "strict": sum(episode.success_strict for episode in episodes),
        "reasons": [list(entry) for entry in failed.most_common()],
        "cpu_ms_step": round(1000 * spent / sum(len(episode.success) for episode in episodes), 2),
    }


def stamps(task: Task, variation: str, region: str) -> tuple[str, str]:
    """Return what a line has as ``stamp`` and ``worlds``."""
    return portability.stamp(task), portability.worlds_stamp(task, variation, region)
