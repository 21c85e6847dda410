"""Small datasets of this package in order -> one dataset, row group by row group.

Mirrors ``aggregate_datasets`` of LeRobot 0.6.1, which takes half a second to open a part and rewrites the merged file
for each: minutes for a thousand episodes. ``tests/lerobot_demohlm/datasets/test_dataset.py`` compares the results: it
fails where a later LeRobot merges otherwise.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.io_utils import load_info, load_stats, load_tasks, write_info, write_stats
from lerobot.datasets.utils import DEFAULT_CHUNK_SIZE
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.episode import Episode, executed_of
from lerobot_demohlm.datasets.facts import GenerationFacts
from lerobot_demohlm.datasets.modality import write_modality
from lerobot_demohlm.datasets.pictures import DrawnBlock, DrawnEpisode, is_drawn, is_video, video_file
from lerobot_demohlm.datasets.writer import NEXT_SUCCESS, data_file, episodes_file, read_arrays, write_dataset
from lerobot_demohlm.reproducibility import fingerprint

_SHIFTED_STATS = ("min", "max", "mean", "q01", "q10", "q50", "q90", "q99")


def first_episodes(source: Path, root: Path, records: Sequence[dict[str, Any]], facts: GenerationFacts) -> Path:
    """Write the first episodes of a dataset again, as many as there are records."""
    labels = pq.read_table(source / episodes_file(0)).to_pylist()
    episodes = [
        Episode.of_record(
            record,
            task=facts.task,
            task_text=label["tasks"][0],
            seed=facts.seed,
            region=facts.region,
            state=arrays[OBS_STATE],
            environment_state=arrays[OBS_ENV_STATE],
            action=arrays[ACTION],
            success=arrays[NEXT_SUCCESS],
            fingerprints=fingerprint.from_bytes(label["fingerprints"]),
            executed=executed_of(label, record["frames"]),
        )
        for record, arrays, label in zip(records, read_arrays(source), labels, strict=False)
    ]
    write_dataset(root, "local/block", episodes, facts, _first_drawn(source, root, labels, episodes))
    return root


def _first_drawn(
    source: Path, root: Path, labels: Sequence[dict[str, Any]], episodes: Sequence[Episode]
) -> DrawnBlock | None:
    """Return the pictures of the first episodes of a dataset, cut out of its videos; None where it has none."""
    table = {key: feature for key, feature in load_info(source).features.items() if is_drawn(key, feature)}
    if not table:
        return None
    video_keys = [key for key, feature in table.items() if is_video(feature)]
    num_frames = sum(len(episode.success) for episode in episodes)
    files = {key: root.with_name(f"{root.name}-{key}.mp4") for key in video_keys}
    for key, path in files.items():
        videos.cut(source / video_file(key, 0, 0), path, num_frames)
    drawn, start = [], 0
    for episode, arrays, label in zip(episodes, read_arrays(source), labels, strict=False):
        stats = {
            key: {name: np.array(label[f"stats/{key}/{name}"]) for name in _names_of_stats(label, key)}
            for key in video_keys
        }
        columns = {key: arrays[key] for key in table if key not in video_keys}
        drawn.append(DrawnEpisode(columns=columns, stats=stats, start=start))
        start += len(episode.success)
    return DrawnBlock(features=table, episodes=drawn, files=files)


def _names_of_stats(label: dict[str, Any], key: str) -> list[str]:
    return [name.removeprefix(f"stats/{key}/") for name in label if name.startswith(f"stats/{key}/")]


def merge(
    parts: Sequence[Path],
    repo_id: str,
    root: Path,
    progress: Callable[[int, int], None] | None = None,
    file_size_mb: float | None = None,
) -> None:
    """Merge datasets that ``write_dataset`` wrote, of one task, in their order.

    Args:
        parts: Their roots, one or more.
        repo_id: Name of the merged dataset on the hub.
        root: Where; must not exist.
        progress: Called with (parts merged, parts in all).
        file_size_mb: A data file that has grown beyond this is followed by a new one; LeRobot's size by default.
    """
    first = load_info(parts[0])
    video_keys = [key for key, feature in first.features.items() if is_video(feature)]
    meta = LeRobotDatasetMetadata.create(
        repo_id, first.fps, first.features, robot_type=first.robot_type, root=root, use_videos=bool(video_keys)
    )
    limit = (file_size_mb or meta.info.data_files_size_in_mb) * 2**20
    tasks = load_tasks(parts[0])
    meta.save_episode_tasks(list(tasks.index))
    writers: list[pq.ParquetWriter] = []  # one a data file, all but the last closed
    rows, stats = [], []
    for done, part in enumerate(parts, start=1):
        info = load_info(part)
        if info.features != first.features or not load_tasks(part).equals(tasks):
            got, expected = f"{part} with other features or tasks", f"those of {parts[0]}"
            raise DatasetError(got, expected, "merge one task at a time")
        source = pq.ParquetFile(part / data_file(0))
        if not writers or (root / data_file(len(writers) - 1)).stat().st_size >= limit:
            for writer in writers[-1:]:
                writer.close()
            target = _with_folder(root, data_file(len(writers)))
            writers.append(pq.ParquetWriter(target, source.schema_arrow, compression="snappy"))
        episodes, frames = meta.info.total_episodes, meta.info.total_frames
        for group in range(source.num_row_groups):
            writers[-1].write_table(_shifted(source.read_row_group(group), episodes, frames))
        table = _shifted_rows(pq.read_table(part / episodes_file(0)), episodes, frames, len(writers) - 1)
        rows.append(_with_videos(table, part, root, done - 1, video_keys))
        stats.append(load_stats(part))
        meta.info.total_episodes += info.total_episodes
        meta.info.total_frames += info.total_frames
        if progress is not None:
            progress(done, len(parts))
    writers[-1].close()
    pq.write_table(pa.concat_tables(rows), _with_folder(root, episodes_file(0)), compression="snappy")
    meta.info.total_tasks = len(tasks)
    meta.info.splits = {"train": f"0:{meta.info.total_episodes}"}
    write_info(meta.info, root)
    if video_keys:
        write_modality(root, meta.features)
    merged_stats = aggregate_stats(stats)
    write_stats({key: merged_stats[key] for key in meta.features}, root)  # LeRobot's order changes with the hash seed
    LeRobotDataset(repo_id, root=root)  # opens, or the merge is not handed over


def _with_videos(table: pa.Table, part: Path, root: Path, index: int, keys: Sequence[str]) -> pa.Table:
    """Copy a part's videos as one more file of each, and return its episodes' rows, which say where they are."""
    chunk, file = divmod(index, DEFAULT_CHUNK_SIZE)
    for key in keys:
        shutil.copyfile(part / video_file(key, 0, 0), _with_folder(root, video_file(key, chunk, file)))
        for name, value in (("chunk_index", chunk), ("file_index", file)):
            table = _replaced(table, f"videos/{key}/{name}", np.full(len(table), value))
    return table


def _with_folder(root: Path, relative: Path) -> Path:
    """Make a file's folder and return the file's path."""
    (root / relative).parent.mkdir(parents=True, exist_ok=True)
    return root / relative


def _shifted(table: pa.Table, episodes: int, frames: int) -> pa.Table:
    """Return an episode's frames with their indices counted from the start of the merged dataset."""
    for name, offset in (("episode_index", episodes), ("index", frames)):
        table = _replaced(table, name, table.column(name).to_numpy() + offset)
    return table


def _shifted_rows(table: pa.Table, episodes: int, frames: int, file_index: int) -> pa.Table:
    """Return the rows of ``meta/episodes`` as they are in the merged dataset."""
    count = len(table)
    for name, offset in (("episode_index", episodes), ("dataset_from_index", frames), ("dataset_to_index", frames)):
        table = _replaced(table, name, table.column(name).to_numpy() + offset)
    table = _replaced(table, "data/file_index", np.full(count, file_index))
    for name, offset in (("episode_index", episodes), ("index", frames)):
        for stat in _SHIFTED_STATS:
            column = f"stats/{name}/{stat}"
            values = [[value + offset for value in row] for row in table.column(column).to_pylist()]
            table = _replaced(table, column, values)
    return table


def _replaced(table: pa.Table, name: str, values: Any) -> pa.Table:  # noqa: ANN401
    """Replace a column's values and keep its type."""
    position = table.schema.get_field_index(name)
    field = table.schema.field(position)
    return table.set_column(position, field, pa.array(values, type=field.type))
