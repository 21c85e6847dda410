"""An attempt at a task as arrays -> the facts and records that a dataset keeps of it; without torch or lerobot.

What the generation runner needs, in the order in which it needs it (3 to 6 live in ``generation_run.py``, which imports
lerobot only where it writes or merges, through ``dataset_files.py``):

1. ``Episode``: one attempt, success or not. A failed attempt may have no frames.
2. ``GenerationFacts``: what a run is a function of. Two runs with equal facts end in equal datasets.
3. ``GenerationRun.open(root, repo_id, facts)``: starts the run or resumes a killed one. Raises ``DatasetError``
   where ``root`` exists, or where ``<root>.partial`` was begun with other facts. Nothing is at ``root`` until the end.
4. Attempts are cut into blocks of ``facts.block_size`` consecutive ones. ``run.pending_blocks()`` yields the
   ``range`` of attempt indices of every block that is not on disk, in order, while the target is not met.
5. ``write_block(run.directory, facts, attempts, episodes)`` writes one block as a small finalized dataset. Callable
   from any process; the block appears by one rename, so ``kill -9`` loses only blocks still being computed.
6. ``run.finish(progress)`` merges the blocks in the order of the attempts, whatever worker computed them, drops what
   lies past the target, writes ``meta/demohlm.json``, ``meta/demohlm_attempts.jsonl`` and the card, and renames it to
   ``root``.

Only successful episodes are frames of the dataset; every attempt, failed ones included, is a line of
``meta/demohlm_attempts.jsonl``. With ``facts.keep_failures`` failed attempts that have frames become a second dataset,
``<root>-failures``.
"""

import importlib.metadata
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import observation
from gym_demohlm.control import command
from gym_demohlm.errors import DatasetError

FPS = 10
ROBOT_TYPE = "unitree_g1"
FORMAT_VERSION = 1  # of meta/demohlm.json and meta/demohlm_attempts.jsonl
OUTCOMES = ("success", "ik_failed", "fell", "dropped", "collided", "timeout", "off_course")
FACTS_PATH = Path("meta/demohlm.json")
ATTEMPTS_PATH = Path("meta/demohlm_attempts.jsonl")
_RECORDED_PACKAGES = ("lerobot_env_demohlm", "lerobot", "mujoco", "numpy", "placo", "torch")


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One attempt at a task at 10 Hz, successful or not."""

    task: str
    """Name of the task, without version: ``LiftBox``."""
    task_text: str
    """The task in words, as a language-conditioned policy reads it."""
    index: int
    """Index of the attempt in its run, from 0."""
    seed: int
    """Seed of the run (the attempt is a function of seed and index)."""
    region: str
    """Initial region: R1, R2 or R3."""
    outcome: str
    """One of ``OUTCOMES``."""
    stage: str
    """Stage in which the attempt ended: the last one, where it succeeded."""
    state: np.ndarray
    """(T, 68) float32, ``observation.STATE_NAMES``, before each action."""
    environment_state: np.ndarray
    """(T, 9k) float32, tracked objects in the camera frame, before each action."""
    action: np.ndarray
    """(T, 23) float32, ``command.NAMES``."""
    success: np.ndarray
    """(T,) bool, whether the task's condition held after each action."""
    initial_state: dict[str, list[float]]
    """What the reset drew, by name: robot and object poses [m, rad]."""
    length_s: float
    """Simulated time until the attempt ended [s]."""

    def __post_init__(self) -> None:
        """Check shapes, types and values, so that nothing invalid travels."""
        if self.outcome not in OUTCOMES:
            raise DatasetError(f"outcome {self.outcome!r}", f"one of {', '.join(OUTCOMES)}", "name a known outcome")
        width = self.environment_state.shape[-1] if self.environment_state.ndim == 2 else -1
        expected = {
            "state": (len(self.success), len(observation.STATE_NAMES)),
            "environment_state": (len(self.success), width),
            "action": (len(self.success), command.SIZE),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise DatasetError(
                    f"{name} {array.dtype} {array.shape}", f"float32 {shape}", "give one row a step of success"
                )
            if not np.isfinite(array).all():
                raise DatasetError(f"NaN or infinity in {name}", "finite numbers", "discard this attempt")
        if self.success.dtype != np.bool_ or self.success.ndim != 1:
            raise DatasetError(f"success {self.success.dtype} {self.success.shape}", "bool (T,)", "convert it")
        if self.outcome == "success" and len(self.success) == 0:
            raise DatasetError("a successful episode without frames", "one frame or more", "record its steps")

    def record(self) -> dict[str, Any]:
        """Return the attempt's line of ``meta/demohlm_attempts.jsonl``, without arrays."""
        return {
            "attempt": self.index,
            "outcome": self.outcome,
            "stage": self.stage,
            "length_s": round(float(self.length_s), 3),
            "frames": len(self.success),
            "initial_state": {name: [float(v) for v in values] for name, values in self.initial_state.items()},
        }


def installed_versions() -> dict[str, str]:
    """Return the versions of the packages whose code decides what an episode is."""
    return {name: importlib.metadata.version(name) for name in _RECORDED_PACKAGES}


@dataclass(frozen=True, kw_only=True)
class GenerationFacts:
    """What a generation run is a function of; written to ``meta/demohlm.json``."""

    task: str
    task_text: str
    region: str
    seed: int
    demonstration_hash: str
    controller_hash: str
    model_hash: str
    num_episodes: int | None = None
    """Target: stop at this many successes (attempts after the last of them do not count)."""
    num_attempts: int | None = None
    """Target: make exactly this many attempts. One of the two targets is given."""
    block_size: int = 8
    """Attempts a block: what one worker computes and finalizes at once."""
    keep_failures: bool = False
    versions: dict[str, str] = field(default_factory=installed_versions)
    format_version: int = FORMAT_VERSION

    def __post_init__(self) -> None:
        """Check the target and the block size."""
        targets = [target for target in (self.num_episodes, self.num_attempts) if target is not None]
        if len(targets) != 1 or targets[0] < 1 or self.block_size < 1:
            raise DatasetError(
                f"num_episodes={self.num_episodes}, num_attempts={self.num_attempts}, block_size={self.block_size}",
                "one of the two targets, at least 1, and blocks of at least 1",
                "give --num-episodes or --num-attempts",
            )


def require_new_root(root: Path) -> None:
    """Raise ``DatasetError`` where the root exists: a dataset is never written over another one."""
    if root.exists():
        raise DatasetError(f"the root {root}, which exists", "a path that does not exist", "choose another --root")


def count_outcomes(records: Iterable[dict[str, Any]]) -> dict[str, int]:
    """Count attempts by outcome, every outcome named, in the order of ``OUTCOMES``."""
    counts = Counter(record["outcome"] for record in records)
    return {outcome: counts[outcome] for outcome in OUTCOMES}


def write_facts(root: Path, facts: GenerationFacts, records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Write ``meta/demohlm.json`` and ``meta/demohlm_attempts.jsonl`` and return what the former says."""
    outcomes = count_outcomes(records)
    content = asdict(facts) | {
        "attempts": len(records),
        "successes": outcomes["success"],
        "success_rate": outcomes["success"] / len(records),
        "outcomes": outcomes,
    }
    (root / FACTS_PATH).write_text(json.dumps(content, indent=2) + "\n")
    (root / ATTEMPTS_PATH).write_text("".join(json.dumps(record) + "\n" for record in records))
    return content


def read_facts(root: Path) -> dict[str, Any]:
    """Return a dataset's ``meta/demohlm.json``.

    Raises:
        DatasetError: There is no such dataset, it is not one of this project, or another version wrote it.
    """
    path = Path(root) / FACTS_PATH
    if not path.is_file():
        raise DatasetError(f"{root} without {FACTS_PATH}", "a dataset that `demohlm generate` wrote", "check --root")
    try:
        content = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise DatasetError(f"{path}, damaged ({error})", "a JSON object", "generate the dataset again") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise DatasetError(
            f"{path} of format version {version}",
            f"format version {FORMAT_VERSION}",
            "generate the dataset again, or install the version of lerobot_env_demohlm that wrote it",
        )
    return content


def read_attempts(root: Path) -> list[dict[str, Any]]:
    """Return the lines of a dataset's ``meta/demohlm_attempts.jsonl``: every attempt, failed ones included."""
    return [json.loads(line) for line in (Path(root) / ATTEMPTS_PATH).read_text().splitlines()]
