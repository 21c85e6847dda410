"""A LeRobot dataset without images -> the same samples from memory, for training on a CPU.

LeRobot reads a sample with a chunk of 20 actions in 3.4 ms, so a batch of 512 takes 1.8 s where a step of the MLP takes
0.1 s. Here the columns are tensors and a batch is one indexing operation a column: 0.02 s.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

from lerobot_demohlm.dataset_files import to_numpy


class InMemoryDataset(LeRobotDataset):
    """A dataset whose samples come from memory, equal to those of the ``LeRobotDataset`` it is made ``of``."""

    _columns: dict[str, Tensor]
    _tasks: list[str]
    _deltas: dict[str, Tensor]
    _starts: Tensor
    _stops: Tensor

    @classmethod
    def of(cls, dataset: LeRobotDataset) -> Self:
        """Hold a dataset without images in memory.

        Args:
            dataset: Opened as LeRobot opens it, ``delta_timestamps`` and choice of episodes included.
        """
        held = cls.__new__(cls)
        held.__dict__.update(dataset.__dict__)
        table = dataset.hf_dataset.with_format("arrow")[:]
        held._columns = {name: torch.from_numpy(to_numpy(table.column(name)).copy()) for name in table.column_names}
        held._tasks = list(dataset.meta.tasks.index)  # pyright: ignore[reportOptionalMemberAccess]
        deltas = dataset.reader.delta_indices or {}
        held._deltas = {key: torch.as_tensor(steps) for key, steps in deltas.items()}
        _, episode, lengths = torch.unique_consecutive(
            held._columns["episode_index"], return_inverse=True, return_counts=True
        )
        stops = lengths.cumsum(0)
        held._starts, held._stops = (stops - lengths)[episode], stops[episode]  # (num_frames,) of each frame's episode
        return held

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """Return the samples at these indices; what torch's loader asks for where it exists."""
        rows = torch.as_tensor(indices)
        batch = {name: column[rows] for name, column in self._columns.items()}
        starts, stops = self._starts[rows, None], self._stops[rows, None]
        for key, deltas in self._deltas.items():
            wanted = rows[:, None] + deltas  # (B, num_deltas)
            batch[f"{key}_is_pad"] = (wanted < starts) | (wanted >= stops)
            batch[key] = self._columns[key][torch.minimum(torch.maximum(wanted, starts), stops - 1)]
        tasks = [self._tasks[index] for index in batch["task_index"].tolist()]
        samples = zip(*(column.unbind(0) for column in batch.values()), strict=True)
        return [
            {**dict(zip(batch, sample, strict=True)), "task": task} for sample, task in zip(samples, tasks, strict=True)
        ]

    def __getitem__(self, idx: int | slice) -> Any:  # noqa: ANN401
        """Return one sample, or several for a slice."""
        if isinstance(idx, slice):
            return self.__getitems__(range(*idx.indices(len(self))))
        return self.__getitems__([idx])[0]


@contextmanager
def in_memory_batches() -> Iterator[None]:
    """Let LeRobot's training, called inside, hold datasets without images in memory; give it ``num_workers=0``."""
    from lerobot.scripts import lerobot_train

    original: Callable[..., Any] = lerobot_train.make_train_eval_datasets

    def held(cfg: Any) -> tuple[Any, ...]:  # noqa: ANN401
        return tuple(
            InMemoryDataset.of(dataset)
            if isinstance(dataset, LeRobotDataset) and not dataset.meta.camera_keys
            else dataset
            for dataset in original(cfg)
        )

    lerobot_train.make_train_eval_datasets = held
    try:
        yield
    finally:
        lerobot_train.make_train_eval_datasets = original
