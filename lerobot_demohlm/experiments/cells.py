"""One cell of a table -> its result: generate what is missing, train, roll out; each resumes where it was."""

import json
import math
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gym_demohlm.errors import DatasetError, NoSuccessError
from gym_demohlm.files import replace_text
from lerobot_demohlm.datasets.facts import count_attempts, read_attempts, read_facts
from lerobot_demohlm.evaluation.evaluate import evaluate
from lerobot_demohlm.evaluation.loaded_policy import load_policy
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.evaluation.rollouts import Setting
from lerobot_demohlm.evaluation.scoring import SEEDS_A_CELL
from lerobot_demohlm.experiments.layout import Layout
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import Cell, RegionCell
from lerobot_demohlm.experiments.variants import PLAIN, VARIANTS
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import made_so_far, partial_directory
from lerobot_demohlm.generation.runner import generate
from lerobot_demohlm.policies.presets import get_preset
from lerobot_demohlm.policies.training import checkpoint, train
from lerobot_demohlm.reproducibility.run_lock import RunLock

DATA_SEED = 0  # of the datasets; a policy's seed is that of its training
CAMERAS = ("head:96x96:rgb",)  # of the datasets of policies that see


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is done for a cell.

    Attributes:
        num_rollouts: Rollouts of a policy.
        num_attempts: Attempts of generation in a region.
        data_workers: Processes that make a cell's data, or its attempts.
        device: Where policies are trained and act.
        deadline: Begin nothing after this time (``time.monotonic``) [s].
    """

    num_rollouts: int = 250
    num_attempts: int = 500
    data_workers: int = 1
    device: str = "cpu"
    deadline: float = math.inf

    def __post_init__(self) -> None:
        """Check that the starts of a cell are its own."""
        if self.num_rollouts > SEEDS_A_CELL:
            raise DatasetError(
                f"num_rollouts={self.num_rollouts}",
                f"at most {SEEDS_A_CELL}, or tasks share starts",
                "correct --num-rollouts",
            )

    @property
    def is_over(self) -> bool:
        """Tell whether the time is up."""
        return time.monotonic() >= self.deadline


def run_cell(cell: Cell | RegionCell, layout: Layout, effort: Effort) -> PolicyResult | GenerationResult | None:
    """Return a cell's result, or None where the time was up before it was done.

    Args:
        cell: Which.
        layout: Where everything is.
        effort: How much.

    Raises:
        DatasetError: Another process is at work on this cell, in this root.
    """
    torch.set_num_threads(1)  # other cells have the other cores
    if isinstance(cell, RegionCell):
        with _alone(layout.generation(cell, effort.num_attempts)):
            return _run_region(cell, layout, effort)
    with _alone(layout.rollouts(cell)):
        return _run_policy(cell, layout, effort)


@contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Lock a directory from outside of it: a second process would delete what the first makes there.

    What is locked stays on disk: a lock that is removed can be held twice, in the old folder and in a new one.
    """
    beside = directory.parent / ".locks" / directory.name
    beside.mkdir(parents=True, exist_ok=True)
    lock = RunLock(beside)
    try:
        yield
    finally:
        lock.release()


def _run_region(cell: RegionCell, layout: Layout, effort: Effort) -> GenerationResult | None:
    """Return the result of the first attempts in a region."""
    count = effort.num_attempts
    root = layout.generation(cell, count)
    if not root.exists():
        if effort.is_over:
            return None
        worlds = replace(VARIANTS[PLAIN], variation=cell.variation)
        try:
            generate(replace(_request(cell, root, effort), num_attempts=count, variation=worlds))
        except NoSuccessError:  # no dataset, but a result
            return _counted(cell, made_so_far(partial_directory(root)))
    return _counted(cell, read_attempts(root))


def _counted(cell: RegionCell, records: Sequence[dict[str, Any]]) -> GenerationResult:
    """Return the result of these attempts."""
    lengths = [record["length_s"] for record in records if record["outcome"] == "success"]
    return GenerationResult(
        **asdict(cell),
        **count_attempts(records),
        episode_s=round(sum(lengths) / len(lengths), 2) if lengths else None,
        stamp=cell.stamp,
    )


def _request(cell: Cell | RegionCell, root: Path, effort: Effort) -> GenerationRequest:
    """Return the request for a cell's dataset, without its size; a larger one begins with the same attempts."""
    seed = cell.seed if isinstance(cell, RegionCell) else DATA_SEED
    return GenerationRequest(
        task=cell.task,
        region=cell.region,
        seed=seed,
        root=root,
        num_workers=effort.data_workers,
        show_progress=False,
    )


def _run_policy(cell: Cell, layout: Layout, effort: Effort) -> PolicyResult | None:
    training = layout.training(cell)
    if not layout.times(cell).exists():
        with _alone(training):
            if not layout.times(cell).exists() and not _trained(cell, layout, effort):
                return None
    began, output = time.monotonic(), layout.rollouts(cell)
    before = output.read_bytes().count(b"\n") if output.exists() else 0  # the last line may be torn
    rollouts = evaluate(
        load_policy(checkpoint(training), cell.task, effort.device),
        Setting(task=cell.task, region=cell.region, variation=cell.variation, perception=cell.perception),
        range(cell.first_seed, cell.first_seed + effort.num_rollouts),
        output,
        deadline=effort.deadline,
    )
    made, elapsed = len(rollouts) - before, time.monotonic() - began
    if len(rollouts) < effort.num_rollouts:
        return None
    return PolicyResult(
        **asdict(cell),
        recipe=cell.recipe,
        stamp=cell.stamp,
        policy_type=rollouts[0].policy,
        policy_hash=rollouts[0].policy_hash,
        code=rollouts[0].code,
        first_seed=cell.first_seed,
        episodes=len(rollouts),
        successes=sum(rollout.success_held for rollout in rollouts),
        successes_end=sum(rollout.success_end for rollout in rollouts),
        successes_ever=sum(rollout.success_ever for rollout in rollouts),
        successes_strict=_count_strict(rollouts),
        outcomes=dict(Counter(rollout.outcome for rollout in rollouts)),
        data_success_rate=read_facts(layout.data(cell))["success_rate"],
        rollouts_per_hour=round(3600 * made / elapsed) if made > 0 else None,
        **json.loads(layout.times(cell).read_text()),
    )


def _count_strict(rollouts: Sequence[Rollout]) -> int | None:
    """Return how many succeeded strictly; None where some are from before that was judged."""
    found = [rollout.success_strict for rollout in rollouts]
    return None if None in found else sum(map(bool, found))


def _trained(cell: Cell, layout: Layout, effort: Effort) -> bool:
    """Train a cell's policy, on data that is made where it is missing; return whether there was time to begin it."""
    dataset = layout.data(cell)
    if not dataset.exists():
        if effort.is_over:
            return False
        request = _request(cell, dataset, effort)
        cameras = CAMERAS if cell.sees else None
        count, variation = cell.num_train_episodes, VARIANTS[cell.variant]
        generate(replace(request, num_episodes=count, variation=variation, cameras=cameras))
    if effort.is_over:
        return False
    _train(cell, dataset, layout, effort)
    return True


def _train(cell: Cell, dataset: Path, layout: Layout, effort: Effort) -> None:
    """Train from the start, also where a training was killed, and note how long it took."""
    preset, training, end = get_preset(cell.policy, cell.preset), layout.training(cell), layout.times(cell)
    shutil.rmtree(training, ignore_errors=True)
    began = time.monotonic()
    path = train(
        training,
        dataset,
        cell.policy,
        cell.preset,
        steps=cell.steps,
        seed=cell.train_seed,
        num_episodes=cell.num_train_episodes,
        device=effort.device,
    )
    elapsed = time.monotonic() - began
    if not path.is_dir():
        raise DatasetError(f"no checkpoint at {path}", "what LeRobot's training writes", "look at its messages")
    samples = cell.steps * preset.batch_size
    times = {
        "train_s": round(elapsed, 1),
        "train_samples_per_s": round(samples / elapsed),
        "train_device": effort.device,
    }
    replace_text(end, json.dumps(times) + "\n")
