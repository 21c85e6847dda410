"""A new controller -> what each check found: benchmark beside the default, demonstrations, lint, generation.

A check changes nothing but its own folder of the work directory, which no other controller shares. It returns what it
found and what fell short.
"""

import functools
import hashlib
import math
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gym_demohlm.control import controllers
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.errors import DemonstrationError, NoSuccessError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.robot.physics import Physics
from gym_demohlm.wbc.evaluation import paired
from gym_demohlm.wbc.evaluation.benchmark import LARGEST_HAND_LOAD
from gym_demohlm.wbc.evaluation.contest import worlds_in
from gym_demohlm.wbc.evaluation.episodes import Trials, trials
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange
from lerobot_demohlm.checks import lint
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.replay import replay
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.runner import generate
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.teleop.record import record, script_of

LEAST_SUCCESS = 0.97
"""Share of attempts that must succeed in each task."""
REGION = "R3"
LINT_AGAIN = (1, 2)
"""Added to the seed when a failed lint is repeated."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is checked, and how thoroughly.

    Attributes:
        weights: File of the new controller.
        work: Directory of what has been found; a later call goes on from there.
        num_robots: Of the benchmark, shared among three seeds and eight pairs of hand loads.
        seconds: Of each of their episodes [s].
        num_attempts: Generated from each new demonstration.
        num_workers: Threads of the benchmark, and processes of generation.
        seed: Of commands, pushes, lint and starts.
    """

    weights: Path
    work: Path
    num_robots: int = 624
    seconds: float = 20.0
    num_attempts: int = 100
    num_workers: int = 2
    seed: int = 7000

    @functools.cached_property
    def key(self) -> str:
        """What findings hold for: both controllers, how thoroughly they were checked, and the code that did it."""
        content = (
            Weights(self.weights).hash,
            controllers.load().hash,
            self.num_robots,
            self.seconds,
            self.num_attempts,
            self.seed,
            provenance.code_hash(),
            provenance.generator_hash(),
            provenance.checker_hash(),
        )
        return hashlib.sha256(repr(content).encode()).hexdigest()[:16]

    @property
    def demonstrations(self) -> Path:
        """Where the demonstrations with the new controller are."""
        return self.work / self.key / "demonstrations"

    def data(self, slug: str) -> Path:
        """Return where a task's attempts are made."""
        return self.work / self.key / "data" / slug


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a check found.

    Attributes:
        numbers: As JSON holds them.
        failures: What fell short, a line each; empty where all went well.
    """

    numbers: dict[str, Any]
    failures: tuple[str, ...] = ()


def benchmark(request: Request) -> Found:
    """Try the new controller and the default one with the same commands, both in the new one's physics."""
    physics = controllers.load(str(request.weights)).settings.physics
    new, old = (
        _tried(request, controllers.find(name), physics) for name in (str(request.weights), controllers.DEFAULT)
    )
    rows = paired.compare(new, old)
    unknown = tuple(
        f"{row.name}: nothing was measured in {request.seconds:g} s, expected a number; give --seconds"
        for row in rows
        if not (math.isfinite(row.low) and math.isfinite(row.high))
    )
    worse = tuple(
        f"{row.name} is {row.new:.4g} beside {row.old:.4g} of the default controller; the difference is between "
        f"{row.low:.2g} and {row.high:.2g}"
        for row in rows
        if row.worse
    )
    return Found(numbers={"rows": [asdict(row) for row in rows], "physics": physics.name}, failures=(*unknown, *worse))


def _tried(request: Request, weights: Path, physics: Physics) -> Trials:
    return trials(
        request.num_robots,
        request.seconds,
        request.seed,
        request.num_workers,
        CommandRange(),
        num_seeds=3,
        largest_hand_load=LARGEST_HAND_LOAD,
        make=worlds_in(weights, physics),
    )


def demonstrate(request: Request, name: str) -> Found:
    """Record a task's demonstration with the new controller and replay it bit for bit."""
    task, root = get_task(name), request.demonstrations / get_task(name).slug
    shutil.rmtree(root, ignore_errors=True)
    script = script_of(task)
    try:
        made = record(task, script.make_operator(), script.start, controller=str(request.weights))
    except DemonstrationError as error:
        return Found(numbers={"task": name}, failures=(f"{name}: no demonstration: {error}",))
    made.save(root, task)
    again = replay(demonstrations.load(root, task), controller=str(request.weights))
    failures = () if again.identical else (f"{name}: {again.lines()[-1]}",)
    return Found(numbers={"task": name, "ticks": len(made), "identical": again.identical}, failures=failures)


def check_task(request: Request, name: str) -> Found:
    """Lint a task with the new controller and its demonstration.

    Some worlds of the lint have random commands, which press things hard by chance. So a check that fails is repeated
    with two more seeds. It counts as failed if it also fails with one of these seeds.
    """
    task = get_task(name)
    made = demonstrations.load(request.demonstrations / task.slug, task)

    def lint_once(seed: int) -> list[lint.Check]:
        return lint.lint(task, made, lint.Settings(seed=seed, controller=str(request.weights)))

    checks = lint_once(request.seed)
    failed = [each for each in checks if not each.ok]
    times = Counter(each.name for each in failed)
    if failed:
        times.update(each.name for seed in LINT_AGAIN for each in lint_once(request.seed + seed) if not each.ok)
    failures = tuple(
        f"{name}: {each.name}: {each.got}, expected {each.expected}" for each in failed if times[each.name] > 1
    )
    numbers = {"task": name, **{each.name: each.number for each in checks}, "failed of three seeds": dict(times)}
    return Found(numbers=numbers, failures=failures)


def attempt(request: Request, name: str) -> Found:
    """Generate from a task's new demonstration in R3, from the beginning, also after a call that was killed."""
    task = get_task(name)
    shutil.rmtree(request.data(task.slug), ignore_errors=True)
    asked = GenerationRequest(
        task=name,
        region=REGION,
        seed=request.seed,
        root=request.data(task.slug),
        num_attempts=request.num_attempts,
        num_workers=request.num_workers,
        demonstration=request.demonstrations / task.slug,
        controller=str(request.weights),
    )
    try:
        summary = generate(asked)
    except NoSuccessError as error:
        return Found(numbers={"task": name, "region": REGION, "successes": 0}, failures=(f"{name}: {error}",))
    least = math.ceil(LEAST_SUCCESS * request.num_attempts)
    failures = ()
    if summary.successes < least:
        failures = (f"{name}: {summary.successes} of {summary.attempts} attempts succeed, expected {least} or more",)
    numbers = {"task": name, "region": REGION, "attempts": summary.attempts, "successes": summary.successes}
    return Found(numbers={**numbers, "outcomes": summary.outcomes}, failures=failures)


def packaged_tasks() -> list[str]:
    """Return the names of the tasks that come with the package."""
    return [name for name, task in all_tasks().items() if task.module.startswith("gym_demohlm.")]


def plan(request: Request) -> list[tuple[str, Callable[[], Found]]]:
    """Return the name of each check and what makes it, in their order."""
    names = packaged_tasks()
    each: dict[str, Callable[[Request, str], Found]] = {
        "demonstration": demonstrate,
        "lint": check_task,
        "generation": attempt,
    }
    made = [(f"{kind} {name}", functools.partial(make, request, name)) for kind, make in each.items() for name in names]
    return [("benchmark", functools.partial(benchmark, request)), *made]
