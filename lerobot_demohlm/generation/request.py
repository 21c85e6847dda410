"""What to generate, and what came of it: the request that workers are made for and the summary that is printed."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from gym_demohlm.control.controllers import DEFAULT
from lerobot_demohlm.datasets.variation import DataVariation

BLOCK_SIZE = 32  # attempts a block: worlds that share the cost of a tick, and what a kill loses of each worker
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
        controller: Name, path or hash of the whole-body controller; a dataset names it by its hash.
        variation: How attempts differ from plain ones. By default their commands carry noise, as policies learn best
            from such data.
        cameras: What is drawn of successful attempts, such as head:96x96:rgb,depth; nothing by default.
        light: By how much each episode's lights differ in pictures, from 0 to about 1.
        texture: The same for the colours of what is not tracked.
        camera_shift: The same for the head camera's place; 1 is 1 cm and 2 degrees.
        wordings: Tell the task to policies in several wordings, one an episode.
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
    controller: str = DEFAULT
    variation: DataVariation = field(default_factory=DataVariation)
    cameras: tuple[str, ...] | None = None
    light: float = 0.0
    texture: float = 0.0
    camera_shift: float = 0.0
    wordings: bool = False
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
        strict_successes: Attempts that succeeded without a fault at any time, whose robot stood for 2 s after it.
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
    strict_successes: int
    episodes_per_hour: float


def summary_json(summary: GenerationSummary) -> dict[str, Any]:
    """Return the summary as the JSON object that ``demohlm generate`` prints, the knobs of the variation flat in it."""
    content: dict[str, Any] = {}
    for entry in fields(summary):
        value = getattr(summary, entry.name)
        content |= value.content() if isinstance(value, DataVariation) else {entry.name: value}
    return content | {"success_rate": round(summary.success_rate, 4)}
