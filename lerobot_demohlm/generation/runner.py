"""What to generate -> worker processes that make blocks of attempts -> one dataset, the same whatever their number.

A block of consecutive attempts is made by one worker as worlds of one simulation and appears on disk by one rename; the
blocks on disk are the only memory of a run. So a run may be killed at any time, and the same call resumes it.
"""

import argparse
import importlib
import json
import multiprocessing
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gym_demohlm.errors import DatasetError, DemoHLMError
from gym_demohlm.scene import build_scene
from gym_demohlm.task import get_task
from lerobot_demohlm import demonstration as demonstrations
from lerobot_demohlm import provenance
from lerobot_demohlm.dataset import GenerationFacts, count_outcomes
from lerobot_demohlm.demonstration import Demonstration
from lerobot_demohlm.generation_run import GenerationRun, write_block
from lerobot_demohlm.segmentation import segment

BLOCK_SIZE = 8  # attempts a block: worlds side by side, and what a kill can lose of each worker
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, kw_only=True)
class GenerationRequest:
    """What to generate.

    Attributes:
        task: Name of the task.
        region: Initial region.
        seed: Attempt i is a function of it, the region, the demonstration and i.
        root: Directory of the dataset; must not exist.
        num_episodes: Stop at this many successes; or
        num_attempts: make exactly this many attempts.
        num_workers: Processes.
        demonstration: Directory of the demonstration; the packaged one by default.
        repo_id: Name of the dataset on the hub.
        keep_failures: Write failed attempts to a second dataset beside it.
        block_size: Attempts a block.
        show_progress: Draw a progress bar on stderr.
    """

    task: str
    region: str
    seed: int
    root: Path
    num_episodes: int | None = None
    num_attempts: int | None = None
    num_workers: int = 1
    demonstration: Path | None = None
    repo_id: str | None = None
    keep_failures: bool = False
    block_size: int = BLOCK_SIZE
    show_progress: bool = True


@dataclass(frozen=True, kw_only=True)
class GenerationSummary:
    """What came out; failures are counted, never skipped.

    Attributes:
        task: Name of the task.
        region: Initial region.
        seed: Of the run.
        attempts: Attempts made.
        successes: Episodes in the dataset.
        success_rate: successes / attempts.
        outcomes: Attempts by outcome.
        episodes_per_hour: Successes an hour of this call; blocks that were on disk before it are not counted.
    """

    task: str
    region: str
    seed: int
    attempts: int
    successes: int
    success_rate: float
    outcomes: dict[str, int]
    episodes_per_hour: float


def generate(request: GenerationRequest) -> GenerationSummary:
    """Generate a dataset; a killed call is resumed by the same call.

    Raises:
        UnknownNameError: No such task or region.
        DemonstrationError: The demonstration cannot be read, is of another task or version, or touches nothing.
        DatasetError: The root exists, a run with other arguments was begun there, or no attempt succeeded.
    """
    task = get_task(request.task)
    task.region(request.region)
    if request.num_workers < 1 or request.seed < 0:
        raise DatasetError(
            f"num_workers={request.num_workers}, seed={request.seed}",
            "at least 1 worker and a seed of 0 or more",
            "change them",
        )
    demonstration = demonstrations.load(request.demonstration, task)
    segment(demonstration)  # fails now rather than in a worker
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
    )
    repo_id = request.repo_id or f"demohlm/{provenance.file_name(task)}_{request.region.lower()}"
    run = GenerationRun.open(Path(request.root), repo_id, facts)
    began, found = time.monotonic(), _successes(run.all_records())
    _make_blocks(run, request, demonstration)
    made = _successes(run.all_records()) - found
    elapsed = time.monotonic() - began
    content = run.finish()
    kept = ("task", "region", "seed", "attempts", "successes", "success_rate", "outcomes")
    return GenerationSummary(
        **{key: content[key] for key in kept},
        episodes_per_hour=round(3600.0 * made / elapsed, 1),
    )


def _successes(records: list[dict[str, Any]]) -> int:
    return count_outcomes(records)["success"]


def _make_blocks(run: GenerationRun, request: GenerationRequest, demonstration: Demonstration) -> None:
    """Keep the workers busy until the target is met."""
    if next(run.pending_blocks(), None) is None:
        return
    pending = run.pending_blocks()
    with _pool(run, request, demonstration) as pool, _Progress(run, request.show_progress) as progress:
        working: set[Future[None]] = set()
        exhausted = False
        while True:
            while not exhausted and len(working) < request.num_workers:
                attempts = next(pending, None)
                exhausted = attempts is None
                if attempts is not None:
                    working.add(pool.submit(_make_block, attempts))
            if not working:
                return
            done, working = wait(working, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
            progress.update()


@contextmanager
def _pool(
    run: GenerationRun, request: GenerationRequest, demonstration: Demonstration
) -> Iterator[ProcessPoolExecutor]:
    """Start worker processes with one thread each; they end with this process, however it ends."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # spawned workers read it when they import NumPy
    pool = ProcessPoolExecutor(
        max_workers=request.num_workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(run.directory, run.facts, demonstration, get_task(run.facts.task).module),
    )
    try:
        yield pool
    except BrokenProcessPool as error:
        raise DemoHLMError(
            "a worker that was killed", "workers that finish", "run the same command again: it resumes"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


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
        records = self._run.all_records()
        return _successes(records) if self._counts_episodes else len(records)

    def update(self) -> None:
        """Count what is on disk."""
        records = self._run.all_records()
        if records:
            self._bar.set_postfix_str(f"success {_successes(records) / len(records):.1%}", refresh=False)
        total = self._bar.total or 0
        self._bar.update(min(self._count(), total) - self._bar.n)

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


# In a worker

_worker: dict[str, Any] = {}


def _start_worker(directory: Path, facts: GenerationFacts, demonstration: Demonstration, task_module: str) -> None:
    from lerobot_demohlm.generation.attempt import Attempts

    importlib.import_module(task_module)  # registers a task from outside the package here too
    threading.Thread(target=_end_with_parent, daemon=True).start()
    attempts = Attempts(get_task(facts.task), demonstration, facts.region, facts.seed, num_worlds=facts.block_size)
    _worker.update(directory=directory, facts=facts, attempts=attempts)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_block(attempts: range) -> None:
    episodes = _worker["attempts"].run(attempts)
    write_block(_worker["directory"], _worker["facts"], attempts, episodes)


def summary_json(summary: GenerationSummary) -> dict[str, Any]:
    """Return the summary as the JSON object that ``demohlm generate`` prints."""
    content = asdict(summary)
    return content | {"success_rate": round(summary.success_rate, 4)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm generate``."""
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument("--region", default="R3", help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the initial states (default: %(default)s)")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--num-episodes", type=int, help="stop at this many successful episodes")
    target.add_argument("--num-attempts", type=int, help="make this many attempts, successful or not")
    parser.add_argument("--num-workers", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--root", type=Path, required=True, help="directory of the dataset; must not exist")
    parser.add_argument("--repo-id", help="name on the hub, user/name (default: made from task and region)")
    parser.add_argument("--demonstration", type=Path, help="directory of the demonstration (default: the packaged one)")
    parser.add_argument("--keep-failures", action="store_true", help="write failed attempts to ROOT-failures")


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
        demonstration=arguments.demonstration,
        repo_id=arguments.repo_id,
        keep_failures=arguments.keep_failures,
    )
    print(json.dumps(summary_json(generate(request))))
