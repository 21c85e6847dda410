"""What to generate -> workers that make blocks of attempts -> one dataset, the same whatever their number and place.

A block of consecutive attempts is made by one worker as worlds of one simulation and appears on disk by one rename; the
blocks on disk are the only memory of a run. So a run may be killed at any time, and the same call resumes it; a worker
may be killed, and another makes its block again.
"""

import argparse
import functools
import importlib
import json
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

from tqdm import tqdm

from gym_demohlm.errors import DatasetError, DemoHLMError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from lerobot_demohlm.datasets.facts import GenerationFacts, installed_versions
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.generation.workers import ProcessWorkers, Workers
from lerobot_demohlm.reproducibility import provenance

BLOCK_SIZE = 32  # attempts a block: worlds that share the cost of a tick, and what a kill loses of each worker
MAX_DEATHS = 3  # of workers at one block, before the run gives up
Backend = Literal["processes", "ray"]


@dataclass(frozen=True, kw_only=True)
class GenerationRequest:
    """What to generate.

    Attributes:
        task: Name of the task.
        region: Initial region.
        seed: Attempt i is a function of this seed, the region, the demonstration, the variation and i.
        root: Directory of the dataset; it must not exist.
        num_episodes: Stop at this many successes; None where ``num_attempts`` is given.
        num_attempts: Make exactly this many attempts; None where ``num_episodes`` is given.
        num_workers: Number of blocks that are made at the same time.
        backend: Where attempts run: in local processes or on a Ray cluster.
        resume: Refuse to begin a run; there must be one to resume. The same request resumes a run without this, too.
        demonstration: Directory of the demonstration; the packaged one by default.
        repo_id: Name of the dataset on the hub.
        keep_failures: Whether failed attempts become a second dataset, ``<root>-failures``.
        block_size: Attempts in a block: worlds that are stepped together, and what a kill loses of each worker.
        variation: How attempts differ from plain ones. By default their commands carry noise, as policies learn best
            from such data.
        show_progress: Draw a progress bar on stderr.
    """

    task: str
    region: str
    seed: int
    root: Path
    num_episodes: int | None = None
    num_attempts: int | None = None
    num_workers: int = 1
    backend: Backend = "processes"
    resume: bool = False
    demonstration: Path | None = None
    repo_id: str | None = None
    keep_failures: bool = False
    block_size: int = BLOCK_SIZE
    variation: DataVariation = field(default_factory=DataVariation)
    show_progress: bool = True


@dataclass(frozen=True, kw_only=True)
class GenerationSummary:
    """What came out; failures are counted, never skipped.

    Attributes:
        task: Name of the task.
        region: Initial region.
        seed: Seed of the run.
        attempts: Number of attempts made.
        successes: Episodes in the dataset.
        success_rate: successes / attempts.
        outcomes: Attempts by outcome.
        variation: How attempts differ from plain ones, as requested.
        first_try_successes: Attempts that succeeded without a retry.
        episodes_per_hour: Successes per hour of this call; blocks that were on disk before it are not counted.
    """

    task: str
    region: str
    seed: int
    attempts: int
    successes: int
    success_rate: float
    outcomes: dict[str, int]
    variation: DataVariation
    first_try_successes: int
    episodes_per_hour: float


def generate(request: GenerationRequest) -> GenerationSummary:
    """Generate a dataset; a killed call is resumed by the same call.

    Raises:
        UnknownNameError: No such task or region.
        DemonstrationError: The demonstration cannot be read, is of another task or version, or touches nothing.
        DatasetError: The root exists or cannot be written, a run with other arguments was begun there, another process
            is at work there, or no attempt succeeded.
        KeyboardInterrupt: Stopped from the keyboard; it says what is kept.
    """
    task = get_task(request.task)
    task.region(request.region)
    if request.num_workers < 1 or request.seed < 0:
        raise DatasetError(
            f"num_workers={request.num_workers}, seed={request.seed}",
            "at least 1 worker and a seed of 0 or more",
            "correct --num-workers or --seed",
        )
    demonstration = demonstrations.load(request.demonstration, task)
    segment(demonstration, task)  # fails now rather than in a worker
    facts = GenerationFacts(
        task=task.name,
        task_text=task.description,
        region=request.region,
        seed=request.seed,
        demonstration_hash=demonstration.content_hash,
        controller_hash=provenance.controller_hash(),
        model_hash=provenance.model_hash(build_scene(task).model),
        num_episodes=request.num_episodes,
        num_attempts=request.num_attempts,
        block_size=request.block_size,
        keep_failures=request.keep_failures,
        variation=request.variation,
    )
    repo_id = request.repo_id or f"demohlm/{task.slug}_{request.region.lower()}"
    run = GenerationRun.open(Path(request.root), repo_id, facts, resume=request.resume)
    try:
        began, found = time.monotonic(), run.num_successes
        if not run.target_met():
            maker = BlockMaker(facts=facts, demonstration=demonstration, task_module=task.module)
            with closing(_workers(maker, run, request)) as workers, _Progress(run, request.show_progress) as progress:
                make_blocks(run, workers, progress.update)
        made, elapsed = run.num_successes - found, time.monotonic() - began
        content = run.finish()
    except KeyboardInterrupt:
        kept = f"{run.num_attempts} attempts are kept in {run.directory}"
        raise KeyboardInterrupt(f"{kept}; the same command goes on from there") from None
    finally:
        run.close()
    kept = ("task", "region", "seed", "attempts", "successes", "success_rate", "outcomes", "first_try_successes")
    return GenerationSummary(
        **{key: content[key] for key in kept},
        variation=request.variation,
        episodes_per_hour=round(3600.0 * made / elapsed, 1),
    )


def make_blocks(run: GenerationRun, workers: Workers, report: Callable[[], None] = lambda: None) -> None:
    """Keep the workers busy until the target is met; a block whose worker dies is given to another.

    Args:
        run: Where blocks are missing.
        workers: What makes the blocks.
        report: Called after each block.

    Raises:
        DemoHLMError: Workers keep dying at one block, or one could not make it.
    """
    pending, again, deaths = run.pending_blocks(), deque[range](), Counter[range]()
    while not run.target_met():
        while workers.free > 0:
            attempts = again.popleft() if again else next(pending, None)
            if attempts is None:
                break
            workers.submit(attempts)
        for block in workers.wait():
            if run.is_done(block.attempts):
                report()
                continue
            deaths[block.attempts] += 1
            if deaths[block.attempts] == MAX_DEATHS:
                first, last = block.attempts.start, block.attempts.stop - 1
                raise DemoHLMError(
                    f"{MAX_DEATHS} workers that died at attempts {first} to {last}, the last one "
                    f"{block.death or 'after its block, which cannot be read'}",
                    "workers that finish",
                    "give them more memory or start fewer of them; the same command goes on",
                )
            again.append(block.attempts)


@dataclass(frozen=True, kw_only=True)
class BlockMaker:
    """Makes blocks of a run in a worker, which need not be of this machine.

    Attributes:
        facts: The run's facts.
        demonstration: The run's demonstration.
        task_module: Name of the module that registers the task.
    """

    facts: GenerationFacts
    demonstration: Demonstration
    task_module: str

    def __call__(self, directory: Path, attempts: range) -> None:
        """Make attempts and write their block into a run's directory."""
        write_block(directory, self.facts, attempts, self._attempts.run(attempts))

    @functools.cached_property
    def _attempts(self) -> Attempts:
        found, expected = installed_versions(), self.facts.versions
        different = [name for name in expected if found.get(name) != expected[name]]
        if different:
            name = different[0]
            raise DatasetError(
                f"a worker with {name} {found.get(name)}",
                f"{name} {expected[name]}, as where the run was begun: other bits would come of it",
                "install the same on all machines, and use one family of processors",
            )
        importlib.import_module(self.task_module)
        facts, settings = self.facts, Settings(variation=self.facts.variation)
        return Attempts(get_task(facts.task), self.demonstration, facts.region, facts.seed, facts.block_size, settings)


def _workers(maker: BlockMaker, run: GenerationRun, request: GenerationRequest) -> Workers:
    if request.backend == "processes":
        return ProcessWorkers(maker, run.directory, request.num_workers)
    try:
        from lerobot_demohlm.generation.ray_workers import RayWorkers
    except ModuleNotFoundError as error:
        raise DemoHLMError("an installation without ray", "the extra [ray]", "uv sync --extra ray") from error
    return RayWorkers(maker, run.directory, request.num_workers)


class _Progress:
    """A bar on stderr that counts towards the target, with the success rate behind it."""

    def __init__(self, run: GenerationRun, shown: bool) -> None:
        self._run, facts = run, run.facts
        self._counts_episodes = facts.num_episodes is not None
        self._bar = tqdm(
            total=facts.num_episodes or facts.num_attempts,
            desc=f"{facts.task} {facts.region}",
            unit="episode" if self._counts_episodes else "attempt",
            disable=not shown,
            smoothing=0.1,
        )
        self._bar.n = self._bar.initial = self._count()
        self.update()

    def _count(self) -> int:
        count = self._run.num_successes if self._counts_episodes else self._run.num_attempts
        return min(count, int(self._bar.total))

    def update(self) -> None:
        """Count what is on disk and draw, whatever the clock on the wall says of the time since the last drawing."""
        attempts = self._run.num_attempts
        if attempts:
            self._bar.set_postfix_str(f"success {self._run.num_successes / attempts:.1%}", refresh=False)
        self._bar.n = self._count()
        self._bar.refresh()

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


def summary_json(summary: GenerationSummary) -> dict[str, Any]:
    """Return the summary as the JSON object that ``demohlm generate`` prints, the knobs of the variation flat in it."""
    content: dict[str, Any] = {}
    for entry in fields(summary):
        value = getattr(summary, entry.name)
        content |= value.content() if isinstance(value, DataVariation) else {entry.name: value}
    return content | {"success_rate": round(summary.success_rate, 4)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm generate``."""
    variation = DataVariation()
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument("--region", default="R3", help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the initial states (default: %(default)s)")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--num-episodes", type=int, help="stop at this many successful episodes")
    target.add_argument("--num-attempts", type=int, help="make this many attempts, successful or not")
    parser.add_argument("--num-workers", type=int, default=1, help="blocks at a time (default: %(default)s)")
    parser.add_argument(
        "--backend",
        choices=get_args(Backend),
        default="processes",
        help="who makes them: processes of this machine, or a Ray cluster (default: %(default)s)",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="refuse to begin: go on with what was begun at ROOT; without it, too, the same command goes on",
    )
    parser.add_argument("--root", type=Path, required=True, help="directory of the dataset; must not exist")
    parser.add_argument("--repo-id", help="name on the hub, user/name (default: made from task and region)")
    parser.add_argument("--demonstration", type=Path, help="directory of the demonstration (default: the packaged one)")
    parser.add_argument("--keep-failures", action="store_true", help="write failed attempts to ROOT-failures")
    parser.add_argument(
        "--retries",
        type=int,
        default=variation.retries,
        help="times that an attempt may walk back and begin again after a missed goal or grip (default: %(default)s)",
    )
    parser.add_argument(
        "--command-noise",
        type=float,
        default=variation.command_noise,
        metavar="SCALE",
        help="execute commands with noise, record them without; 1 is 0.05 m/s, 0.025 rad (default: %(default)s)",
    )
    parser.add_argument(
        "--start-spread",
        type=float,
        default=variation.start_spread,
        metavar="FACTOR",
        help="widen the region's ranges of the robot's pose, x away from the object (default: %(default)s)",
    )
    parser.add_argument(
        "--stance-spread",
        type=float,
        default=variation.stance_spread,
        metavar="SCALE",
        help="walk to places that are off by up to 5 cm and 5 deg, times this (default: %(default)s)",
    )


def main(arguments: argparse.Namespace) -> None:
    """Generate a dataset; the last line on stdout is the summary as JSON."""
    request = GenerationRequest(
        task=arguments.task,
        region=arguments.region,
        seed=arguments.seed,
        root=arguments.root,
        num_episodes=arguments.num_episodes,
        num_attempts=arguments.num_attempts,
        num_workers=arguments.num_workers,
        backend=arguments.backend,
        resume=arguments.resume,
        demonstration=arguments.demonstration,
        repo_id=arguments.repo_id,
        keep_failures=arguments.keep_failures,
        variation=DataVariation(**{knob.name: getattr(arguments, knob.name) for knob in fields(DataVariation)}),
    )
    print(json.dumps(summary_json(generate(request))))
