"""A folder of Parquet files -> some of its columns, of some episodes; without torch or lerobot."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as pads

from gym_demohlm.errors import DatasetError


def read_table(
    folder: Path, columns: Sequence[str], episodes: Sequence[int] | None, optional: Sequence[str] = ()
) -> pa.Table:
    """Read columns of the Parquet files of a folder.

    Args:
        folder: ``data`` or ``meta/episodes`` of a dataset.
        columns: Names of columns that it must have.
        episodes: Rows with one of these in ``episode_index``; all where None.
        optional: Names of columns that are read where they are.

    Raises:
        DatasetError: The folder is missing or damaged, or lacks a column.
    """
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
