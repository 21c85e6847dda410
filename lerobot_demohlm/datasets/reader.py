"""A generated dataset on disk -> its episodes as arrays, with what it takes to repeat them; without torch or lerobot.

Episodes are read a few at a time, so the memory it takes does not grow with the dataset.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import InitialState
from lerobot_demohlm.datasets.cameras import is_video
from lerobot_demohlm.datasets.episode import executed_of
from lerobot_demohlm.datasets.facts import read_attempts, read_info
from lerobot_demohlm.datasets.origin import is_edited, read_origins
from lerobot_demohlm.datasets.tables import read_table
from lerobot_demohlm.reproducibility import fingerprint

STATE, ENVIRONMENT_STATE, ACTION, SUCCESS = (
    "observation.state", "observation.environment_state", "action", "next.success"
)  # fmt: skip
_PLACES = ("episode_index", "length")
_LABELS = ("attempt", "outcome", "fingerprints")  # what `demohlm generate` writes beside what LeRobot does


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredEpisode:
    """An episode of T frames as its dataset holds it.

    Attributes:
        episode: Index in the dataset.
        attempt: Index of the attempt in its run.
        outcome: How that ended.
        digest: SHA-256 of all simulated states.
        initial_state: Where it began.
        fingerprints: (T + 1, 4) uint32, see ``fingerprint``; None where editing the dataset has lost them.
        commands: (T, 23) as executed: the actions, or these with the noise that they carried. Editing loses the noise,
            so they are the bare actions where there are no fingerprints.
        columns: (T, D) by feature.
    """

    episode: int
    attempt: int
    outcome: str
    digest: str
    initial_state: InitialState
    fingerprints: np.ndarray | None
    commands: np.ndarray
    columns: dict[str, np.ndarray]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.columns[SUCCESS])


def lengths(root: Path) -> dict[int, int]:
    """Return the frames of each episode of a dataset, in their order.

    Raises:
        DatasetError: ``meta/episodes`` is missing or damaged, or lacks what only ``demohlm generate`` writes there.
    """
    return {row["episode_index"]: row["length"] for row in _labels(root, None)}


def has_videos(root: Path) -> bool:
    """Tell whether a dataset has videos: that of failed attempts has none, whatever its run draws.

    Raises:
        DatasetError: ``meta/info.json`` is missing or damaged.
    """
    return any(map(is_video, read_info(root)["features"].values()))


def attempt_of(root: Path, episode: int) -> int:
    """Return which attempt of its run an episode is.

    Raises:
        DatasetError: As ``lengths``, or there is no such episode.
    """
    if is_edited(root):
        for origin in read_origins(root, [episode]).values():
            return origin.record["attempt"]
    for row in _labels(root, [episode]):
        return row["attempt"]
    raise DatasetError(f"episode {episode}", f"one of the episodes of {root}", "choose another --episode")


def read(root: Path, episodes: Sequence[int]) -> list[StoredEpisode]:
    """Read some episodes of a dataset, in the order given.

    Raises:
        DatasetError: The dataset is damaged, or its parts do not belong together.
    """
    labels = {row["episode_index"]: row for row in _labels(root, episodes)}
    if is_edited(root):
        records = {episode: origin.record for episode, origin in read_origins(root, episodes).items()}
    else:
        by_attempt = {record["attempt"]: record for record in read_attempts(root)}
        records = {episode: by_attempt.get(label["attempt"]) for episode, label in labels.items()}
    features = (STATE, ENVIRONMENT_STATE, ACTION, SUCCESS)
    table = read_table(root / "data", ("episode_index", *features), episodes)
    episode_index = table.column("episode_index").to_numpy()
    arrays = {name: _array(table.column(name)) for name in features}
    stored = []
    for episode in episodes:
        label, record, frames = labels[episode], records[episode], episode_index == episode
        count, columns = int(frames.sum()), {name: array[frames] for name, array in arrays.items()}
        kept = label.get("fingerprints")
        fingerprints = None if kept is None else fingerprint.from_bytes(kept)
        executed = None if kept is None else executed_of(label, count)
        if (
            record is None
            or record["frames"] != count
            or (fingerprints is not None and len(fingerprints) != count + 1)
            or label.get("attempt", record["attempt"]) not in (None, record["attempt"])
        ):
            raise DatasetError(
                f"episode {episode} with {count} frames, {'no' if fingerprints is None else len(fingerprints)} "
                f"fingerprints, of attempt {label.get('attempt')} with {record['frames'] if record else 'no'} frames",
                "as many frames as the attempt had, and one fingerprint more",
                "restore the dataset, or generate it again",
            )
        stored.append(
            StoredEpisode(
                episode=episode,
                attempt=record["attempt"],
                outcome=record["outcome"],
                digest=record["digest"],
                initial_state=record["initial_state"],
                fingerprints=fingerprints,
                commands=columns[ACTION] if executed is None else executed,
                columns=columns,
            )
        )
    return stored


def _labels(root: Path, episodes: Sequence[int] | None) -> list[dict[str, Any]]:
    """Return the labels of some episodes, or of all; what editing a dataset loses may be missing, or None."""
    optional = ("executed", *_LABELS) if is_edited(root) else ("executed",)
    wanted = _PLACES if is_edited(root) else (*_PLACES, *_LABELS)
    return read_table(root / "meta" / "episodes", wanted, episodes, optional).to_pylist()


def _array(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column of numbers or equally long lists as (T, D)."""
    values = column.to_numpy()
    return np.stack(values) if values.dtype == object else values[:, None]
