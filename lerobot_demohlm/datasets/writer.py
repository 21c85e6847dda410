"""Episodes -> the files of a LeRobot v3 dataset, and back to arrays.

Mirrors ``LeRobotDataset.add_frame`` and ``save_episode`` of LeRobot 0.6.1.
``tests/lerobot_demohlm/datasets/test_dataset.py`` compares the files: it fails where a later LeRobot writes otherwise.
"""

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_tasks, write_info, write_stats
from lerobot.datasets.utils import DEFAULT_CHUNK_SIZE, DEFAULT_DATA_PATH, DEFAULT_EPISODES_PATH
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import FPS
from lerobot_demohlm.datasets import origin
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import ROBOT_TYPE, GenerationFacts, require_new_root
from lerobot_demohlm.datasets.modality import write_modality
from lerobot_demohlm.datasets.pictures import DrawnBlock, is_video
from lerobot_demohlm.datasets.statistics import episode_stats
from lerobot_demohlm.datasets.wordings import wordings

NEXT_SUCCESS = "next.success"


def data_file(index: int) -> Path:
    """Return where a dataset keeps a file of frames, relative to its root."""
    chunk, file = divmod(index, DEFAULT_CHUNK_SIZE)
    return Path(DEFAULT_DATA_PATH.format(chunk_index=chunk, file_index=file))


def episodes_file(index: int) -> Path:
    """Return where a dataset keeps a file with one row an episode, relative to its root."""
    chunk, file = divmod(index, DEFAULT_CHUNK_SIZE)
    return Path(DEFAULT_EPISODES_PATH.format(chunk_index=chunk, file_index=file))


def features(task: str) -> dict[str, dict[str, Any]]:
    """Return the LeRobot feature table of a task's datasets, every dimension named.

    Args:
        task: Name of a registered task.
    """
    names = {
        OBS_STATE: list(observation.STATE_NAMES),
        OBS_ENV_STATE: list(observation.environment_names(get_task(task))),
        ACTION: list(command.NAMES),
    }
    table: dict[str, dict[str, Any]] = {
        key: {"dtype": "float32", "shape": (len(value),), "names": value} for key, value in names.items()
    }
    table[NEXT_SUCCESS] = {"dtype": "bool", "shape": (1,), "names": ["success"]}
    return table


def write_dataset(
    root: Path,
    repo_id: str,
    episodes: Sequence[Episode],
    facts: GenerationFacts | None = None,
    drawn: DrawnBlock | None = None,
) -> None:
    """Write episodes as one finalized LeRobot v3 dataset with one data file.

    The content equals what ``LeRobotDataset.add_frame`` and ``save_episode`` write (a test compares them), without
    their image step and their frame-by-frame checks: whole arrays are checked by ``Episode`` once.

    Args:
        root: Where; must not exist.
        repo_id: Name of the dataset on the hub, ``user/name``.
        episodes: One or more, of one task, each with frames.
        facts: Of their run, which each episode then names as its origin; none by default.
        drawn: Pictures of the episodes; none by default.
    """
    require_new_root(root)
    if not episodes or any(len(episode.success) == 0 for episode in episodes):
        raise DatasetError("no episode, or one without frames", "one or more episodes with frames", "leave it out")
    table = features(episodes[0].task) | dict({} if drawn is None else drawn.features)
    with_videos = any(is_video(feature) for feature in table.values())
    meta = LeRobotDatasetMetadata.create(repo_id, FPS, table, robot_type=ROBOT_TYPE, root=root, use_videos=with_videos)
    schema = get_hf_features_from_features(meta.features).arrow_schema
    sentences = list(wordings(get_task(episodes[0].task)))
    rows: list[dict[str, Any]] = []
    stats: list[dict[str, dict[str, np.ndarray]]] = []
    for path in (data_file(0), episodes_file(0)):
        (root / path).parent.mkdir(parents=True)
    with pq.ParquetWriter(root / data_file(0), schema=schema, compression="snappy", use_dictionary=True) as writer:
        for episode_index, episode in enumerate(episodes):
            meta.save_episode_tasks([episode.task_text] if facts is None or not facts.wordings else sentences)
            start, length = meta.info.total_frames, len(episode.success)
            columns = _columns(episode, episode_index, start, meta.get_task_index(episode.task_text))
            if drawn is not None:
                columns |= drawn.episodes[episode_index].columns
            writer.write_table(_arrow_table(columns, schema))  # one row group an episode, as LeRobot's writer
            stats.append(episode_stats(columns) | ({} if drawn is None else drawn.episodes[episode_index].stats))
            row = _episode_row(episode, episode_index, start, stats[-1], facts)
            rows.append(row if drawn is None else row | drawn.row(episode_index, length))
            meta.info.total_frames += length
    pq.write_table(pa.Table.from_pylist(rows), root / episodes_file(0), compression="snappy")
    meta.info.total_episodes, meta.info.total_tasks = len(rows), len(load_tasks(root))
    meta.info.splits = {"train": f"0:{len(rows)}"}
    write_info(meta.info, root)
    if drawn is not None:
        drawn.store(root)
        write_modality(root, meta.features)
    merged = functools.reduce(lambda so_far, new: aggregate_stats([so_far, new]), stats)  # one by one, as LeRobot
    write_stats({key: merged[key] for key in meta.features}, root)  # LeRobot's order changes with the hash seed


def _episode_row(
    episode: Episode,
    episode_index: int,
    start: int,
    stats: dict[str, dict[str, np.ndarray]],
    facts: GenerationFacts | None,
) -> dict[str, Any]:
    """Return an episode's row of ``meta/episodes``, in LeRobot's order."""
    length = len(episode.success)
    named = {} if facts is None else origin.columns(facts, episode.record())
    return {
        "episode_index": episode_index,
        "tasks": [episode.task_text],
        "length": length,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": start,
        "dataset_to_index": start + length,
        **episode.labels(),
        **{f"stats/{key}/{name}": value.tolist() for key, each in stats.items() for name, value in each.items()},
        **named,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _columns(episode: Episode, episode_index: int, start: int, task_index: int | None) -> dict[str, Any]:
    """Return an episode's columns, each with T rows, in the order of LeRobot's feature table."""
    length = len(episode.success)
    return {
        OBS_STATE: episode.state,
        OBS_ENV_STATE: episode.environment_state,
        ACTION: episode.action,
        NEXT_SUCCESS: episode.success,
        "timestamp": np.arange(length) / FPS,
        "frame_index": np.arange(length),
        "episode_index": np.full(length, episode_index),
        "index": np.arange(start, start + length),
        "task_index": np.full(length, task_index),
    }


def _arrow_table(columns: dict[str, Any], schema: pa.Schema) -> pa.Table:
    """Convert columns (T,) or (T, D) to an Arrow table without going through Python lists."""
    arrays = []
    for name in schema.names:
        kind, values = schema.field(name).type, columns[name]
        if values.ndim == 1:
            arrays.append(pa.array(values).cast(kind))
        else:
            flat = pa.array(np.ascontiguousarray(values).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, values.shape[1]))
    return pa.Table.from_arrays(arrays, schema=schema)


def read_arrays(root: Path) -> Iterator[dict[str, np.ndarray]]:
    """Yield the columns of every episode of a dataset on disk, in order, as arrays (T,) or (T, D)."""
    meta = LeRobotDatasetMetadata("local/dataset", root=root)
    files = {meta.get_data_file_path(index): None for index in range(meta.total_episodes)}
    for file in files:
        if file.is_absolute() or ".." in file.parts:  # info.json says where, and may come from anybody
            raise DatasetError(f"data at {file} of {root}", "a place inside of the dataset", "do not trust its maker")
        table = pq.read_table(root / file)
        arrays = {name: to_numpy(table.column(name)) for name in table.column_names}
        starts = np.flatnonzero(np.diff(arrays["episode_index"], prepend=-1))
        for start, stop in zip(starts, [*starts[1:], len(table)], strict=True):
            yield {name: array[start:stop] for name, array in arrays.items()}


def to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    """Convert an Arrow column of numbers or of equally long lists to (T,) or (T, D)."""
    array = column.combine_chunks()
    if pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        return array.flatten().to_numpy(zero_copy_only=False).reshape(len(array), -1)
    return array.to_numpy(zero_copy_only=False)
