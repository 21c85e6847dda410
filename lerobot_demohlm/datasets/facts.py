"""A generation run -> the facts and records that a dataset keeps of it; without torch or lerobot.

What the generation runner needs, in the order in which it needs it (3 to 6 live in ``generation/run.py`` and
``generation/block.py``, which import lerobot only where they write or merge, through ``datasets/writer.py``):

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
``<root>-failures``. The rows of ``meta/episodes`` say of each episode which attempt it was, how and in which stage it
ended (``Episode.labels``), so LeRobot reads and filters them:
``dataset.meta.filter_episodes(lambda episode: episode["outcome"] == "fell")``. With command noise they also
hold the commands as executed, (T, 23) float32; the actions of the frames are those that were planned.
"""

import copy
import importlib.metadata
import json
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.perception.disturbance import varies
from gym_demohlm.perception.error_model import fitted_path, read_model
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation.judge import OUTCOMES
from gym_demohlm.task import Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.cameras import PictureFacts
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.reproducibility import provenance

ROBOT_TYPE = "unitree_g1"
FORMAT_VERSION = 1  # of meta/demohlm.json and meta/demohlm_attempts.jsonl
PERCEPTION_FIT = "perception_fit"
FACTS_PATH = Path("meta/demohlm.json")
INFO_PATH = Path("meta/info.json")
ATTEMPTS_PATH = Path("meta/demohlm_attempts.jsonl")
_FACT_TYPES = {
    **dict.fromkeys(("task", "task_text", "region", "demonstration_hash", "controller_hash", "model_hash"), str),
    **dict.fromkeys(("seed", "block_size", "attempts", "successes"), int),
    **dict.fromkeys(("versions", "outcomes"), dict),
    "success_rate": float,
}
_RECORD_TYPES = {
    **dict.fromkeys(("stage", "reason", "digest"), str),
    **dict.fromkeys(("stage_s", "initial_state"), dict),
    "length_s": float | int,
}
_RECORDED_PACKAGES = ("lerobot_env_demohlm", "lerobot", "torch")


def installed_versions() -> dict[str, str]:
    """Return what a dataset records of the installation: packages, Python, C library, kind of processor.

    ``provenance.bit_versions`` names those among them that decide bits.
    """
    versions = {name: importlib.metadata.version(name) for name in _RECORDED_PACKAGES}
    return versions | {"python": platform.python_version()} | provenance.bit_versions()


@dataclass(frozen=True, kw_only=True)
class GenerationFacts:
    """What a generation run is a function of; ``content`` of it is written to ``meta/demohlm.json``.

    What a run chooses has no defaults here: those of ``GenerationRequest`` and ``DataVariation`` are the only ones.

    Attributes:
        task: Name of the task.
        task_text: The task in words.
        region: Initial region.
        seed: Seed of the run.
        demonstration_hash: SHA-256 of the demonstration.
        controller_hash: SHA-256 of the controller's weights.
        model_hash: SHA-256 of the compiled model.
        num_episodes: Target: stop at this many successes; attempts after the last of them do not count. None where the
            target is ``num_attempts``.
        num_attempts: Target: make exactly this many attempts. None where the target is ``num_episodes``.
        block_size: Attempts in a block, which one worker computes and finalizes at once.
        keep_failures: Whether failed attempts become a second dataset.
        variation: How attempts differ from plain ones.
        pictures: What is drawn of the successful attempts; nothing by default.
        wordings: Whether episodes have the task's sentence in several wordings.
        perception_fit: SHA-256 of the errors' model by which objects were seen; empty where none was.
        versions: Versions of what decides bits; those of this installation unless given.
        format_version: Of the files.

    Raises:
        DatasetError: Not exactly one target, or a target or block size below 1.
    """

    task: str
    task_text: str
    region: str
    seed: int
    demonstration_hash: str
    controller_hash: str
    model_hash: str
    num_episodes: int | None
    num_attempts: int | None
    block_size: int
    keep_failures: bool
    variation: DataVariation
    pictures: PictureFacts = field(default_factory=PictureFacts)
    wordings: bool = False
    perception_fit: str = ""
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

    def content(self) -> dict[str, Any]:
        """Return the facts as JSON objects hold them, the knobs of the variation flat among them."""
        content: dict[str, Any] = {}
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in ("wordings", PERCEPTION_FIT) and not value:
                continue  # as facts were before there was a choice
            flat = isinstance(value, DataVariation | PictureFacts)
            content |= value.content() if flat else {entry.name: copy.deepcopy(value)}
        return content

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> "GenerationFacts":
        """Return the facts that ``content`` gave, as ``run.json`` and ``meta/demohlm.json`` hold them.

        Raises:
            DatasetError: A fact is missing.
        """
        optional = "variation", "pictures", "wordings", PERCEPTION_FIT
        names = [entry.name for entry in fields(cls) if entry.name not in optional]
        missing = [name for name in names if name not in content]
        if missing:
            raise DatasetError(f"facts without {', '.join(missing)}", "the facts of a run", "generate it again")
        return cls(
            **{name: content[name] for name in names},
            variation=DataVariation.read(content),
            pictures=PictureFacts.read(content),
            wordings=bool(content.get("wordings", False)),
            perception_fit=str(content.get(PERCEPTION_FIT, "")),
        )


def perception_fit(task: Task, facts: Mapping[str, Any]) -> str:
    """Return the hash of the errors' model by which a run with such facts sees objects now; empty where it has none."""
    knobs = DataVariation.read(facts)
    seen, drawn = PerceptionSettings.read(knobs.perception), varies(get_variation(knobs.variation))
    path = Path(seen.fit) if seen.fit else fitted_path(task)
    if seen.source != "model" and not (drawn and seen.source == "exact" and path.exists()):
        return ""
    return read_model(path, task).hash


def require_new_root(root: Path, option: str = "--root") -> None:
    """Raise ``DatasetError`` where a directory exists that is to be made: nothing is ever written over.

    Args:
        root: The directory.
        option: What names it on the command line.
    """
    if root.exists():
        raise DatasetError(f"{root}, which exists", "a path that does not exist", f"choose another {option}")


def count_outcomes(records: Iterable[dict[str, Any]]) -> dict[str, int]:
    """Count attempts by outcome, every outcome named, in the order of ``OUTCOMES``."""
    counts = Counter(record["outcome"] for record in records)
    return {outcome: counts[outcome] for outcome in OUTCOMES}


def count_attempts(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what ``meta/demohlm.json`` says of attempts, one or more: how many, and how they ended."""
    outcomes = count_outcomes(records)
    return {
        "attempts": len(records),
        "successes": outcomes["success"],
        "success_rate": outcomes["success"] / len(records),
        "outcomes": outcomes,
        "strict_successes": sum(bool(record.get("success_strict")) for record in records),
        "first_try_successes": count_outcomes(record for record in records if not record.get("retries"))["success"],
    }


def write_facts(root: Path, facts: GenerationFacts, records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Write ``meta/demohlm.json`` and ``meta/demohlm_attempts.jsonl`` and return what the former says."""
    content = facts.content() | {"code_hash": provenance.code_hash()} | count_attempts(records)
    (root / FACTS_PATH).write_text(json.dumps(content, indent=2) + "\n")
    jsonl.write(root / ATTEMPTS_PATH, records)
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
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}, damaged ({error})", "a JSON object", "generate the dataset again") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if version != FORMAT_VERSION:
        raise DatasetError(
            f"{path} of format version {version}",
            f"format version {FORMAT_VERSION}",
            "generate the dataset again, or install the version of lerobot_env_demohlm that wrote it",
        )
    wrong = [name for name, kind in _FACT_TYPES.items() if not isinstance(content.get(name), kind)] or unsound(content)
    if wrong:
        raise DatasetError(f"{path}, damaged ({', '.join(wrong)})", "the facts of a run", "generate the dataset again")
    return content


def read_info(root: Path) -> dict[str, Any]:
    """Return a dataset's ``meta/info.json``: LeRobot's description of it, with ``features`` and ``total_episodes``.

    Raises:
        DatasetError: There is no such file, or it is damaged.
    """
    path = Path(root) / INFO_PATH
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise DatasetError(f"{root} without {INFO_PATH}", "a LeRobot dataset", "check --root") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}, damaged ({error})", "a JSON object", "generate the dataset again") from error
    kinds = {"features": dict, "total_episodes": int}
    wrong = [name for name in kinds if not isinstance(content, dict) or not isinstance(content.get(name), kinds[name])]
    if wrong:
        raise DatasetError(f"{path}, damaged ({', '.join(wrong)})", "a dataset's facts", "generate the dataset again")
    return content


def unsound(facts: Mapping[str, Any]) -> list[str]:
    """Return the names of facts whose values cannot be: a file may say anything, and name a module to be imported."""
    wrong = [] if ":" not in facts["task"] else ["task"]
    if not all(isinstance(version, str) for version in facts["versions"].values()):
        wrong.append("versions")
    for name, read in (("variation", DataVariation.read), ("pictures", PictureFacts.read)):
        try:
            read(facts)
        except (TypeError, ValueError, AttributeError, KeyError):
            wrong.append(name)
    return wrong


def read_attempts(root: Path) -> list[dict[str, Any]]:
    """Return the lines of a dataset's ``meta/demohlm_attempts.jsonl``: every attempt, failed ones included.

    Raises:
        DatasetError: There is no such file, it is damaged, or a version wrote it that kept less of an attempt.
    """
    path = Path(root) / ATTEMPTS_PATH
    records = read_records(path)
    check_records(records, str(path))
    return records


def check_records(records: Iterable[dict[str, Any]], source: str) -> None:
    """Raise ``DatasetError`` where a record lacks what this version keeps of an attempt.

    Args:
        records: What ``Episode.record`` gave.
        source: Where they were read, for the message.
    """
    records = list(records)
    wrong = {
        name for record in records for name, kind in _RECORD_TYPES.items() if not isinstance(record.get(name), kind)
    }
    if not wrong and not all(_is_numbers(value) for record in records for value in record["initial_state"].values()):
        wrong = {"initial_state"}
    if wrong:
        raise DatasetError(
            f"{source} without {', '.join(sorted(wrong))}", "attempts as this version keeps them", "generate them again"
        )


def _is_numbers(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(each, float | int) for each in value)


def is_record(value: object) -> bool:
    """Tell whether a value read from a file has an attempt's index, its frames and its outcome."""
    if not isinstance(value, dict) or value.get("outcome") not in OUTCOMES:
        return False
    return all(type(count) is int and count >= 0 for count in (value.get("attempt"), value.get("frames")))


def read_records(path: Path) -> list[dict[str, Any]]:
    """Return what ``Episode.record`` gave, one a line.

    Raises:
        DatasetError: There is no such file, or it is damaged.
    """
    records = jsonl.read(path)
    for number, record in enumerate(records, start=1):
        if not is_record(record):
            raise DatasetError(f"{path}:{number}, damaged", "an attempt", "generate the dataset again")
    return records
