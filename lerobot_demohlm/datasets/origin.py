"""Where an episode comes from <-> numbers that LeRobot's editing tools carry along; without torch or lerobot.

``lerobot-edit-dataset`` writes ``meta/episodes`` anew. Of columns that it does not know it keeps those that look like
statistics, and it copies no other file of ``meta``. So each row of ``meta/episodes`` holds the facts of its run and the
record of its attempt a second time, as a JSON text whose bytes are the "minimum" of a feature that does not exist.
Episodes that were deleted, split off or merged can thus be verified and explained, and each names its own run.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as pads

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.facts import (
    ATTEMPTS_PATH,
    FACTS_PATH,
    GenerationFacts,
    check_records,
    count_attempts,
    is_record,
    read_attempts,
    read_facts,
    unsound,
)
from lerobot_demohlm.datasets.tables import read_table
from lerobot_demohlm.reproducibility import provenance

COLUMN = "stats/demohlm/min"
SIZE = 4096
"""Bytes of the text, filled up with zeros. LeRobot stacks the statistics of all episodes, so all have one length."""
_REST = {
    "stats/demohlm/max": [0.0],
    "stats/demohlm/mean": [0.0],
    "stats/demohlm/std": [0.0],
    "stats/demohlm/count": [1],
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Origin:
    """Where one episode comes from.

    Attributes:
        facts: Of its run, as in ``meta/demohlm.json`` but for the counts of attempts.
        record: Of its attempt, as a line of ``meta/demohlm_attempts.jsonl``.
    """

    facts: dict[str, Any]
    record: dict[str, Any]


def columns(facts: GenerationFacts, record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the episode's row of ``meta/episodes`` holds of its origin.

    Args:
        facts: Of the run.
        record: ``Episode.record()``.
    """
    run = facts.content() | {"code_hash": provenance.code_hash()}
    text = json.dumps({"facts": run, "record": record}, separators=(",", ":")).encode()
    if len(text) > SIZE:  # a task of very many words or objects: its edited datasets say that nothing is known
        text = b""
    return {COLUMN: list(text.ljust(SIZE, b"\0")), **_REST}


def is_edited(root: Path) -> bool:
    """Tell whether a dataset has lost ``meta/demohlm.json`` or its attempts, as an edited one has."""
    return not all((root / path).is_file() for path in (FACTS_PATH, ATTEMPTS_PATH))


def is_generated(root: Path) -> bool:
    """Tell whether `demohlm generate` wrote a dataset, or one that it was made from by LeRobot's tools."""
    if (root / FACTS_PATH).is_file():
        return True
    try:
        return COLUMN in pads.dataset(root / "meta" / "episodes", format="parquet").schema.names
    except (OSError, pa.ArrowException):
        return False


def read_origins(root: Path, episodes: Sequence[int] | None = None) -> dict[int, Origin]:
    """Return where episodes of a dataset come from, by episode, in their order.

    Args:
        root: Of the dataset, edited or not.
        episodes: Which; all by default.

    Raises:
        DatasetError: It is no dataset, or it says nothing of its origin.
    """
    if not (root / "meta" / "episodes").is_dir():
        raise DatasetError(f"{root} without {FACTS_PATH}", "a dataset that `demohlm generate` wrote", "check --root")
    rows = read_table(root / "meta" / "episodes", ("episode_index",), episodes, optional=(COLUMN,)).to_pylist()
    return {row["episode_index"]: _origin(root, row["episode_index"], row.get(COLUMN)) for row in rows}


def read_run(root: Path, episode: int | None = None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the facts of a run and the records of its attempts, of a dataset that may have been edited.

    Of an edited dataset, only the attempts are known that are episodes of it.

    Args:
        root: Of the dataset.
        episode: One whose run is wanted, where several were merged.

    Raises:
        DatasetError: It is no such dataset, or it has episodes of several runs and none is named.
    """
    if not is_edited(root):
        return read_facts(root), read_attempts(root)
    origins = read_origins(root)
    if episode is not None and episode not in origins:
        raise DatasetError(f"episode {episode}", f"one of the {len(origins)} of {root}", "choose another --episode")
    facts = runs(origins) if episode is None else [origins[episode].facts]
    if len(facts) > 1:
        raise DatasetError(
            f"{root}, merged of {len(facts)} runs", "the episodes of one run", "name an episode with --episode"
        )
    records = {each.record["attempt"]: each.record for each in origins.values() if each.facts == facts[0]}
    kept = [records[attempt] for attempt in sorted(records)]
    return facts[0] | count_attempts(kept), kept


def runs(origins: Mapping[int, Origin]) -> list[dict[str, Any]]:
    """Return the facts of every run that episodes come from, each once."""
    found: dict[str, dict[str, Any]] = {}
    for each in origins.values():
        found.setdefault(json.dumps(each.facts, sort_keys=True), each.facts)
    return list(found.values())


def task_of(root: Path) -> str:
    """Return the name of a dataset's task.

    Raises:
        DatasetError: It is no dataset of this project, or it has several tasks.
    """
    if not is_edited(root):
        return read_facts(root)["task"]
    tasks = sorted({facts["task"] for facts in runs(read_origins(root))})
    if len(tasks) != 1:
        raise DatasetError(f"{root} with {', '.join(tasks) or 'no task'}", "one task", "split it by task")
    return tasks[0]


def _origin(root: Path, episode: int, content: Sequence[int] | None) -> Origin:
    try:
        text = bytes(content or ()).rstrip(b"\0")
    except (TypeError, ValueError):
        text = b"damaged"
    if not text:
        raise DatasetError(
            f"{root} without {FACTS_PATH}, and episode {episode} without its origin",
            "a dataset that `demohlm generate` wrote",
            "check --root; of an edited dataset, use the one that it was made from",
        )
    try:
        found = json.loads(text)
        facts, record = found["facts"], found["record"]
        check_records([record], f"the origin of episode {episode}")
        names = ("task", "region", "demonstration_hash", "controller_hash", "model_hash")
        sound = is_record(record) and all(isinstance(facts[name], str) for name in names)
        sound = sound and isinstance(facts["seed"], int) and isinstance(facts["versions"], dict)
        sound = sound and not unsound(facts)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        sound, facts, record = False, {}, {}
    if not sound:
        raise DatasetError(
            f"{root} with a damaged origin of episode {episode}", "facts and a record", "restore the dataset"
        )
    return Origin(facts=facts, record=record)
