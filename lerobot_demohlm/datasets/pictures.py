"""What was drawn of a block's episodes <-> columns, statistics and files of a LeRobot dataset."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.timing import FPS
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.cameras import CameraSpec

POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
Stats = dict[str, dict[str, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class DrawnEpisode:
    """What was drawn of one episode of T frames.

    Attributes:
        columns: (T, 7) pose of each camera's frame ``optical`` in the world, by feature.
        stats: LeRobot's statistics of each video.
        start: Index of its first frame in the videos.
    """

    columns: Mapping[str, np.ndarray]
    stats: Stats
    start: int


@dataclass(frozen=True, kw_only=True)
class DrawnBlock:
    """What was drawn of the successful episodes of a block.

    Attributes:
        features: Entries of LeRobot's table of features.
        episodes: One an episode, in order.
        files: A video file for each video feature.
    """

    features: Mapping[str, dict[str, Any]]
    episodes: Sequence[DrawnEpisode]
    files: Mapping[str, Path]

    def row(self, index: int, length: int) -> dict[str, Any]:
        """Return what an episode's row of ``meta/episodes`` says of its videos.

        Args:
            index: Of the episode.
            length: Its frames.
        """
        start = self.episodes[index].start
        row: dict[str, Any] = {}
        for key in self.files:
            row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"] = 0, 0
            row[f"videos/{key}/from_timestamp"] = start / FPS
            row[f"videos/{key}/to_timestamp"] = (start + length) / FPS
        return row

    def store(self, root: Path) -> None:
        """Move the files to where a dataset with one file of each video has them."""
        for key, path in self.files.items():
            target = root / video_file(key, 0, 0)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(path, target)


def video_file(key: str, chunk: int, file: int) -> Path:
    """Return where a dataset keeps a video, relative to its root."""
    return Path(videos.VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file))


def features_of(cameras: Sequence[CameraSpec], intrinsics: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return the entries of cameras in LeRobot's table of features.

    Args:
        cameras: The cameras.
        intrinsics: fx, fy, cx, cy [px] of each, by its name; they are kept with each video.
    """
    table: dict[str, Any] = {}
    for camera in cameras:
        for stream in camera.streams:
            entry = videos.video_feature(camera.width, camera.height, stream == "depth")
            entry["info"] |= {"intrinsics": dict(intrinsics[camera.name])}
            table[camera.key(stream)] = entry
        table[camera.pose_key] = {"dtype": "float32", "shape": (7,), "names": list(POSE_NAMES)}
    return table


def is_video(feature: Mapping[str, Any]) -> bool:
    """Tell whether an entry of the table of features is a video."""
    return feature["dtype"] == "video"


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Tell whether an entry of the table of features is a video of depths."""
    return is_video(feature) and bool(feature["info"]["is_depth_map"])


def is_drawn(key: str, feature: Mapping[str, Any]) -> bool:
    """Tell whether an entry of the table of features is there because of a camera."""
    return is_video(feature) or key.startswith("camera.")
