"""A generated dataset on disk -> its episodes as arrays, with what it takes to repeat them; without torch or lerobot.

Episodes are read a few at a time, so the memory it takes does not grow with the dataset.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pads

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import InitialState
from lerobot_demohlm.datasets.episode import executed_of
from lerobot_demohlm.datasets.facts import read_attempts
from lerobot_demohlm.reproducibility import fingerprint

STATE, ENVIRONMENT_STATE, ACTION, SUCCESS = (
    "observation.state", "observation.environment_state", "action", "next.success"
)  # fmt: skip
_LABELS = ("episode_index", "length", "attempt", "outcome", "fingerprints")


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredEpisode:
    """An episode of T frames as its dataset holds it.

    Attributes:
        episode: Index in the dataset.
        attempt: Index of the attempt in its run.
        outcome: How that ended.
        digest: SHA-256 of all simulated states.
        initial_state: Where it began.
        fingerprints: (T + 1, 4) uint32, see ``fingerprint``.
        commands: (T, 23) as executed: the actions, or these with the noise that they carried.
        columns: (T, D) by feature.
    """

    episode: int
    attempt: int
    outcome: str
    digest: str
    initial_state: InitialState
    fingerprints: np.ndarray
    commands: np.ndarray
    columns: dict[str, np.ndarray]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.fingerprints) - 1


def lengths(root: Path) -> dict[int, int]:
    """Return the frames of each episode of a dataset, in their order.

    Raises:
        DatasetError: ``meta/episodes`` is missing or damaged, or lacks what only ``demohlm generate`` writes there.
    """
    return {row["episode_index"]: row["length"] for row in _labels(root, None)}


def attempt_of(root: Path, episode: int) -> int:
    """Return which attempt of its run an episode is.

    Raises:
        DatasetError: As ``lengths``, or there is no such episode.
    """
    for row in _labels(root, [episode]):
        return row["attempt"]
    raise DatasetError(f"episode {episode}", f"one of the episodes of {root}", "choose another --episode")


def read(root: Path, episodes: Sequence[int]) -> list[StoredEpisode]:
    """Read some episodes of a dataset, in the order given.

    Raises:
        DatasetError: The dataset is damaged, or its parts do not belong together.
    """
    labels = {row["episode_index"]: row for row in _labels(root, episodes)}
    records = {record["attempt"]: record for record in read_attempts(root)}
    features = (STATE, ENVIRONMENT_STATE, ACTION, SUCCESS)
    table = _table(root / "data", ("episode_index", *features), episodes)
    episode_index = table.column("episode_index").to_numpy()
    arrays = {name: _array(table.column(name)) for name in features}
    stored = []
    for episode in episodes:
        label, frames = labels[episode], episode_index == episode
        record, fingerprints = records.get(label["attempt"]), fingerprint.from_bytes(label["fingerprints"])
        count, columns = int(frames.sum()), {name: array[frames] for name, array in arrays.items()}
        executed = executed_of(label, count)
        if record is None or record["frames"] != count or len(fingerprints) != count + 1:
            raise DatasetError(
                f"episode {episode} with {count} frames, {len(fingerprints)} fingerprints, of attempt "
                f"{label['attempt']} with {record['frames'] if record else 'no'} frames",
                "as many frames as the attempt had, and one fingerprint more",
                "restore the dataset, or generate it again",
            )
        stored.append(
            StoredEpisode(
                episode=episode,
                attempt=label["attempt"],
                outcome=label["outcome"],
                digest=record["digest"],
                initial_state=record["initial_state"],
                fingerprints=fingerprints,
                commands=columns[ACTION] if executed is None else executed,
                columns=columns,
            )
        )
    return stored


def _labels(root: Path, episodes: Sequence[int] | None) -> list[dict[str, Any]]:
    """Return the labels of some episodes, or of all."""
    return _table(root / "meta" / "episodes", _LABELS, episodes, optional=("executed",)).to_pylist()


def _table(
    folder: Path, columns: Sequence[str], episodes: Sequence[int] | None, optional: Sequence[str] = ()
) -> pa.Table:
    """Read columns of the Parquet files of a folder, optional ones where they are: of some episodes, or all."""
    chosen = None if episodes is None else pads.field("episode_index").isin(list(episodes))
    try:
        files = pads.dataset(folder, format="parquet")
        missing = [name for name in columns if name not in files.schema.names]
        if not missing:
            present = [name for name in optional if name in files.schema.names]
            return files.to_table(columns=[*columns, *present], filter=chosen)
    except (OSError, pa.ArrowException) as error:
        text = " ".join(str(error).split())[:200]
        raise DatasetError(f"{folder} that cannot be read ({text})", "Parquet files", "restore the dataset") from None
    raise DatasetError(
        f"{folder} without {', '.join(missing)}",
        "a dataset as `demohlm generate` wrote it, with a fingerprint of every step",
        "generate it again with this version: the same seed gives the same attempts",
    )


def _array(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column of numbers or equally long lists as (T, D)."""
    values = column.to_numpy()
    return np.stack(values) if values.dtype == object else values[:, None]
