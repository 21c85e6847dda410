"""A demonstration that has just been recorded -> whether episodes can be generated from it: some attempts, at once.

The attempts run in a process of their own, so that whoever waits for them goes on meanwhile.
"""

import importlib
import multiprocessing
import os
import pickle
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing import connection
from typing import Any

from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION, Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.reproducibility.processes import end_with_parent

MIN_TRIED = 5  # attempts after which none that succeeded is a verdict


@dataclass(frozen=True, kw_only=True)
class TrialSettings:
    """What is tried.

    Attributes:
        attempts: How many.
        region: Where they start.
        seed: Of their starts; not one that datasets use.
        together: Attempts that run side by side in one simulation.
    """

    attempts: int = 20
    region: str = DEFAULT_REGION
    seed: int = 990_000
    together: int = 5


@dataclass(frozen=True, kw_only=True)
class TrialReport:
    """How a trial stands.

    Attributes:
        attempts: To be made.
        done: Made so far.
        successes: Of these.
        reasons: Reason of failure and how often, the most frequent first.
        error: What kept the trial from being made; empty where nothing did.
        died: Whether that is the end of its process, which says nothing of the demonstration.
    """

    attempts: int
    done: int
    successes: int
    reasons: tuple[tuple[str, int], ...] = ()
    error: str = ""
    died: bool = False

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to wait for."""
        return bool(self.error) or self.done >= self.attempts

    @property
    def hopeless(self) -> bool:
        """Whether nothing can be generated from the demonstration."""
        none_succeeded = self.finished and self.done >= MIN_TRIED and self.successes == 0
        return not self.died and (bool(self.error) or none_succeeded)


@dataclass(frozen=True, kw_only=True)
class _Job:
    module: str
    task: str
    demonstration: Demonstration
    settings: TrialSettings
    controller: str


@dataclass(kw_only=True)
class Trial:
    """Attempts under way; ``close`` ends them.

    Args:
        task: Of the demonstration.
        demonstration: What they are generated from.
        settings: How many, and where.
        controller: Name, path or hash of the whole-body controller.
    """

    task: Task
    demonstration: Demonstration
    settings: TrialSettings = field(default_factory=TrialSettings)
    controller: str = DEFAULT

    def __post_init__(self) -> None:
        """Start the process."""
        self._outcomes: list[tuple[str, str]] = []
        self._error, self._died = "", False
        job = _Job(
            module=self.task.module,
            task=self.task.name,
            demonstration=self.demonstration,
            settings=self.settings,
            controller=self.controller,
        )
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe(duplex=False)
        self._pipe: connection.Connection = here
        self._process = context.Process(target=_work, args=(there, pickle.dumps(job)), daemon=True)
        before = os.environ.get("OMP_NUM_THREADS")
        os.environ["OMP_NUM_THREADS"] = "1"  # the process reads it when it begins
        try:
            self._process.start()
        finally:
            del os.environ["OMP_NUM_THREADS"]
            if before is not None:
                os.environ["OMP_NUM_THREADS"] = before
        there.close()

    def report(self) -> TrialReport:
        """Return how it stands now."""
        ended = False
        try:
            while self._pipe.poll():
                kind, content = self._pipe.recv()
                if kind == "error":
                    self._error = str(content)
                else:
                    self._outcomes += content
        except (EOFError, OSError):
            ended = True
        done = len(self._outcomes)
        if ended and done < self.settings.attempts and not self._error:
            self._process.join(1.0)
            self._died = True
            self._error = f"the process of the trial ended with exit code {self._process.exitcode}"
        failed = Counter(reason for outcome, reason in self._outcomes if outcome != "success")
        return TrialReport(
            attempts=self.settings.attempts,
            done=done,
            successes=sum(outcome == "success" for outcome, _ in self._outcomes),
            reasons=tuple(failed.most_common(5)),
            error=self._error,
            died=self._died,
        )

    def close(self) -> None:
        """End it, whatever it is at."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _work(pipe: Any, packed: bytes) -> None:  # noqa: ANN401  either end of a pipe
    """Make the attempts and send (outcome, reason) of each, a few at a time."""
    end_with_parent()
    os.nice(5)  # the page comes first
    try:
        job: _Job = pickle.loads(packed)
        importlib.import_module(job.module)  # a task from outside registers itself
        from lerobot_demohlm.generation.attempt import Attempts

        settings = job.settings
        num_worlds = min(settings.together, settings.attempts)
        task, region, seed = get_task(job.task), settings.region, settings.seed
        attempts = Attempts(task, job.demonstration, region, seed, num_worlds, controller=job.controller)
        for first in range(0, settings.attempts, settings.together):
            indices = range(first, min(first + settings.together, settings.attempts))
            pipe.send(("outcomes", [(e.outcome, _short(e.outcome, e.reason)) for e in attempts.run(indices)]))
    except DemoHLMError as error:
        pipe.send(("error", str(error)))


def _short(outcome: str, reason: str) -> str:
    """Return a reason without its numbers' tail, so that like ones count together."""
    return f"{outcome}: {reason.partition(' (')[0]}" if reason else outcome
