"""A generated dataset -> LeRobot's own samples from memory, a batch by one indexing operation a column.

LeRobot reads a sample with a chunk of 20 actions in milliseconds, so a batch of 512 takes many times a training step
of the MLP. Here the columns are tensors, and torch's loader gets a batch that is stacked already. Pictures are held
where they fit (``held_pictures.py``).

``install`` makes ``lerobot-train`` open such datasets this way, and makes their batches in its own process. LeRobot's
plugin mechanism calls it. LeRobot starts four loading processes by default, which import everything before the first
step, and then hand over batches more slowly than they are made here. Any other dataset is read as before, and
``DEMOHLM_IN_MEMORY=0`` in the environment leaves them all alone.
"""

import copy
import functools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow.dataset as pads
import torch
from lerobot.datasets import LeRobotDataset, factory
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats
from torch.utils.data import default_collate
from torch.utils.data._utils.collate import default_collate_fn_map

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.floors import RANGE_FLOOR, STD_FLOOR
from lerobot_demohlm.datasets.held_pictures import HeldPictures, fit_in_memory
from lerobot_demohlm.datasets.origin import is_generated
from lerobot_demohlm.datasets.writer import to_numpy

SWITCH = "DEMOHLM_IN_MEMORY"
_UNSEEN: ContextVar[Callable[[str], bool]] = ContextVar("unseen", default=lambda key: False)
"""Whether the policy that a dataset is opened for has no such input."""


class Sample(dict[str, Any]):
    """One sample of a ``Batch``; torch stacks a list of them as it stacks dictionaries."""


class Batch(Sequence[Sample]):
    """Samples that are stacked already: torch's ``default_collate`` takes the columns as they are.

    Args:
        columns: (B, ...) tensors, or lists of B strings, by name.
    """

    def __init__(self, columns: dict[str, Any]) -> None:
        self.columns = columns

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401
        """Return one sample, or a list of them for a slice."""
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        return Sample({name: column[index] for name, column in self.columns.items()})

    def __iter__(self) -> Iterator[Sample]:
        return (self[index] for index in range(len(self)))


def _stack(samples: Sequence[Sample], *, collate_fn_map: object = None) -> dict[str, Any]:
    return dict(samples.columns) if isinstance(samples, Batch) else default_collate([dict(each) for each in samples])


default_collate_fn_map[Sample] = _stack  # torch's way to teach its loader a type


class InMemoryDataset(LeRobotDataset):
    """A LeRobot dataset that holds its columns in memory, if `demohlm generate` wrote it and its pictures fit there.

    Datasets that LeRobot's tools have made of such ones are held, too.

    Samples equal those of ``LeRobotDataset`` with the same arguments. Statistics differ twice, also where pictures do
    not fit: what never moves counts as if it moved a little (``floors.py``), and where some of the episodes are chosen,
    the statistics are of those, so that a policy trained on the first hundred knows nothing of the others.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        """Open it as ``LeRobotDataset`` does, with the same arguments."""
        super().__init__(*args, **kwargs)
        self.is_held = False
        if not is_generated(self.root):
            return
        names = [name for name in self.hf_dataset.column_names if name not in self.meta.camera_keys]
        table: Any = self.hf_dataset.select_columns(names).with_format("arrow")[:]
        missing = sorted(self.meta.features.keys() - set(self.meta.video_keys) - set(table.column_names))
        if missing:
            got, expected = f"{self.root} without the column {missing[0]}", "all that its meta/info.json names"
            raise DatasetError(got, expected, "restore the dataset, or generate it again")
        columns = {name: to_numpy(table.column(name)) for name in table.column_names}
        unseen = {key for key in self.meta.video_keys if _UNSEEN.get()(key)}
        self.meta = copy.copy(self.meta)
        features = {key: entry for key, entry in self.meta.features.items() if key not in unseen}
        self.meta.info = replace(self.meta.info, features=features)
        self.meta.stats = _floored(self._stats(columns))
        self.is_held = fit_in_memory(self)
        if not self.is_held:
            return
        self._columns = {name: torch.from_numpy(values.copy()) for name, values in columns.items()}
        self._tasks = list(self.meta.tasks.index)  # pyright: ignore[reportOptionalMemberAccess]
        deltas = self.reader.delta_indices or {}
        self._deltas = {key: torch.as_tensor(steps) for key, steps in deltas.items() if key not in unseen}
        _, episode, lengths = torch.unique_consecutive(
            self._columns["episode_index"], return_inverse=True, return_counts=True
        )
        stops = lengths.cumsum(0)
        self._starts, self._stops = (stops - lengths)[episode], stops[episode]  # (num_frames,) of each frame's episode
        self._pictures = HeldPictures(self, self._starts, self._stops) if self.meta.video_keys else None

    def _stats(self, columns: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
        """Return the statistics of the episodes that were chosen."""
        stats = dict(self.meta.stats or {})
        if self.episodes is not None:
            for name in stats.keys() & columns.keys():
                values = columns[name]
                if values.dtype.kind == "f":
                    exact = values.astype(np.float64)  # a long sum of squares in single precision loses the deviation
                    stats[name] = get_feature_stats(exact, axis=0, keepdims=values.ndim == 1)
            stats |= self._picture_stats(self.episodes)
        return stats

    def _picture_stats(self, episodes: Sequence[int]) -> dict[str, dict[str, np.ndarray]]:
        """Return the statistics of the pictures of episodes, by camera: those of each are in ``meta/episodes``."""
        prefixes = {key: f"stats/{key}/" for key in self.meta.video_keys}
        if not prefixes:
            return {}
        source = pads.dataset(self.root / "meta" / "episodes", format="parquet")
        names = [name for name in source.schema.names if name.startswith(tuple(prefixes.values()))]
        chosen = source.to_table(columns=names, filter=pads.field("episode_index").isin(list(episodes))).to_pylist()
        theirs = copy.copy(self.meta)
        theirs.stats = aggregate_stats(
            [
                {
                    key: {name.removeprefix(prefix): np.array(row[name]) for name in names if name.startswith(prefix)}
                    for key, prefix in prefixes.items()
                }
                for row in chosen
            ]
        )
        theirs.rescale_depth_stats(self.depth_output_unit)  # as LeRobot does with those of all episodes
        return theirs.stats

    def __getitems__(self, indices: Sequence[int]) -> Sequence[Any]:
        """Return the samples at these indices; what torch's loader asks for where it exists."""
        if not self.is_held:
            return [super(InMemoryDataset, self).__getitem__(index) for index in indices]
        rows = torch.as_tensor(indices)
        rows = torch.where(rows < 0, rows + len(self), rows)
        batch: dict[str, Any] = {
            name: column[rows] for name, column in self._columns.items() if name not in self._deltas
        }
        starts, stops = self._starts[rows, None], self._stops[rows, None]
        for key, deltas in self._deltas.items():
            wanted = rows[:, None] + deltas  # (B, num_deltas)
            batch[f"{key}_is_pad"] = (wanted < starts) | (wanted >= stops)
            wanted = torch.minimum(torch.maximum(wanted, starts), stops - 1)
            batch[key] = self._columns[key][wanted] if key in self._columns else self._frames(key, wanted)
        batch |= {key: self._frames(key, rows) for key in self.meta.video_keys if key not in self._deltas}
        batch["task"] = [self._tasks[index] for index in batch["task_index"].tolist()]
        return Batch(batch)

    def _frames(self, key: str, rows: torch.Tensor) -> torch.Tensor:
        assert self._pictures is not None  # as there is such a video
        return self._pictures.batch(key, rows)

    def __getitem__(self, idx: int | slice) -> Any:  # noqa: ANN401
        """Return one sample, or several for a slice."""
        if not self.is_held:
            return super().__getitem__(idx)
        if isinstance(idx, slice):
            return list(self.__getitems__(range(*idx.indices(len(self)))))
        return dict(self.__getitems__([idx])[0])


def _floored(stats: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """Return statistics whose deviations, and ranges of observations that are no pictures, are not below the floors."""
    floored = {}
    for key, entry in stats.items():
        entry = dict(entry)
        if "std" in entry:
            entry["std"] = np.maximum(entry["std"], STD_FLOOR)
        if key.startswith("observation.") and "images" not in key and {"min", "max"} <= entry.keys():
            low, high = entry["min"], entry["max"]
            narrow = high - low < RANGE_FLOOR
            middle = (low + high) / 2
            entry["min"] = np.where(narrow, middle - RANGE_FLOOR / 2, low)
            entry["max"] = np.where(narrow, middle + RANGE_FLOOR / 2, high)
        floored[key] = entry
    return floored


def install() -> None:
    """Let LeRobot's training open datasets as ``InMemoryDataset``, unless the environment's switch says 0.

    A training on a dataset that is held in memory then gets ``num_workers=0``, which a line of its log says.
    """
    if os.environ.get(SWITCH, "1") == "0":
        return
    factory.LeRobotDataset = InMemoryDataset  # pyright: ignore[reportPrivateImportUsage]
    make = factory.make_dataset
    if not hasattr(make, "__wrapped__"):
        factory.make_dataset = _without_workers(make)


def _without_workers(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Wrap LeRobot's ``make_dataset``, which gets the configuration before any loading process is started.

    Pictures that the policy does not look at are left out: to decode them costs more than all else.
    """

    @functools.wraps(make)
    def wrapped(cfg: Any) -> Any:  # noqa: ANN401
        seen = getattr(cfg.policy, "input_features", None)
        token = _UNSEEN.set(lambda key: bool(seen) and key not in seen)
        try:
            dataset = make(cfg)
        finally:
            _UNSEEN.reset(token)
        if isinstance(dataset, InMemoryDataset) and dataset.is_held and cfg.num_workers > 0:
            logging.info(
                "The dataset is held in memory, so no loading processes are started: num_workers=0 instead of "
                f"{cfg.num_workers}. {SWITCH}=0 in the environment turns this off."
            )
            cfg.num_workers = 0
        return dataset

    return wrapped
