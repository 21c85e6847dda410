"""A dataset's videos -> their frames in memory, decoded once by LeRobot's own decoder, and batches of them.

Frames are kept as they are encoded, a byte a colour and two a depth, and turned to numbers as LeRobot turns them when a
batch is asked for.
"""

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.datasets.video_utils import decode_video_frames

SHARE = 0.5
"""Of the memory that is free, which frames may take."""


def free_bytes() -> float:
    """Return how much memory is free, in a container what its limit leaves; infinite where the system does not tell."""
    return min(_free_of_machine(), _free_of_container())


def _free_of_machine() -> float:
    try:
        with open("/proc/meminfo") as file:
            told = dict(line.split(":", 1) for line in file)
        return 1024.0 * float(told["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return math.inf


def _free_of_container(folder: Path = Path("/sys/fs/cgroup")) -> float:
    try:
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        limit, used = (float((folder / name).read_text()) for name in ("memory.max", "memory.current"))
        return limit - used + float(stat["inactive_file"])  # copies of files, which go when memory is short
    except (OSError, KeyError, ValueError):  # the limit may be the word "max"
        return math.inf


def needed_bytes(dataset: LeRobotDataset) -> int:
    """Return how much memory the frames of a dataset's videos take, of the episodes that were chosen."""
    depths, total = set(dataset.meta.depth_keys), 0
    for key in dataset.meta.video_keys:
        height, width, channels = dataset.meta.features[key]["shape"]
        total += height * width * (2 if key in depths else channels)
    return total * dataset.num_frames


def fit_in_memory(dataset: LeRobotDataset) -> bool:
    """Tell whether all pictures of a dataset are videos whose frames fit into memory; says so where they do not."""
    if set(dataset.meta.camera_keys) - set(dataset.meta.video_keys):
        return False
    needed, room = needed_bytes(dataset), SHARE * free_bytes()
    if needed > room:
        logging.info(f"The dataset's pictures would take {needed / 1e9:.1f} GB, so they are read from their videos.")
    return needed <= room


class HeldPictures:
    """Frames of all videos of a dataset.

    Args:
        dataset: With its reader loaded.
        starts: (num_frames,) row at which each row's episode begins.
        stops: (num_frames,) row at which it ends.
    """

    def __init__(self, dataset: LeRobotDataset, starts: torch.Tensor, stops: torch.Tensor) -> None:
        self._reader: Any = dataset.reader
        self._depths = set(dataset.meta.depth_keys)
        self._frames: dict[str, torch.Tensor] = {}
        rows = dataset.hf_dataset.with_format("arrow")[:]
        episodes, stamps = (rows.column(name).to_pylist() for name in ("episode_index", "timestamp"))
        bounds = sorted(set(zip(starts.tolist(), stops.tolist(), strict=True)))
        for key in dataset.meta.video_keys:
            height, width, channels = dataset.meta.features[key]["shape"]
            kind = torch.uint16 if key in self._depths else torch.uint8
            held = self._frames[key] = torch.empty((len(rows), channels, height, width), dtype=kind)
            for start, stop in bounds:
                held[start:stop] = self._decoded(dataset, key, episodes[start], stamps[start:stop])

    def batch(self, key: str, rows: torch.Tensor) -> torch.Tensor:
        """Return the frames of rows (B,) or (B, n) as LeRobot gives them: (B, c, h, w), or (B, n, c, h, w) where n > 1.

        Args:
            key: Of the video.
            rows: Of the dataset.
        """
        flat = rows.reshape(-1)
        if key in self._depths:
            found = self._metric(key, _taken(self._frames[key], flat))
        else:
            found = self._frames[key][flat]
            if not self._reader._return_uint8:
                found = found.type(torch.float32) / 255
        several = rows.shape[1:] if rows.ndim > 1 and rows.shape[1] > 1 else ()
        found = found.reshape(len(rows), *several, *found.shape[1:])
        transforms = self._reader._image_transforms
        if transforms is None or key in self._depths:
            return found
        return torch.stack([transforms(frame) for frame in found])

    def _decoded(self, dataset: LeRobotDataset, key: str, episode: int, stamps: Sequence[float]) -> torch.Tensor:
        """Return the frames (T, c, h, w) of an episode as they are encoded."""
        assert dataset.meta.episodes is not None  # a dataset that is read has them
        first = dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
        return decode_video_frames(
            dataset.root / dataset.meta.get_video_file_path(episode, key),
            [first + stamp for stamp in stamps],
            self._reader._tolerance_s,
            self._reader._video_backend,
            return_uint8=True,
            is_depth=key in self._depths,
        )

    def _metric(self, key: str, codes: torch.Tensor) -> torch.Tensor:
        config = self._reader._depth_encoder_configs[key]
        found = dequantize_depth(
            codes,
            depth_min=config.depth_min,
            depth_max=config.depth_max,
            shift=config.shift,
            use_log=config.use_log,
            output_unit=self._reader._depth_output_unit,
        )
        assert isinstance(found, torch.Tensor)  # as its codes are
        return found


def _taken(frames: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return rows of frames of 16 bit, which torch does not index."""
    return frames.view(torch.int16)[rows].view(torch.uint16)
