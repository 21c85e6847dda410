"""What GR00T N1.7 (github.com/NVIDIA/Isaac-GR00T) asks of a dataset with ``meta/modality.json``, in words of ours.

Its loader slices ``start`` to ``end`` of the column ``original_key`` (``observation.state`` or ``action`` where none is
named) and of that column's statistics, decodes the video ``original_key``, and looks a sentence up by the task index in
the annotation's column. The schema of N1.5 also knows ``absolute``, ``dtype``, ``range`` and ``rotation_type``, and
takes height, width and channels from the names of a video's shape.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

COLUMNS = {"state": "observation.state", "action": "action"}
OPTIONAL = {"original_key": str, "absolute": bool, "dtype": str, "range": list, "rotation_type": str}
STATISTICS = ("mean", "std", "min", "max", "q01", "q99")


class GrootReader:
    """Reads a LeRobot dataset part by part, as GR00T's loader does after its own conversion of files to v2.1.

    Args:
        root: Of the dataset.

    Attributes:
        modality: Content of ``meta/modality.json``.
        features: LeRobot's table of features.
    """

    def __init__(self, root: Path) -> None:
        self.modality: dict[str, dict[str, Any]] = json.loads((root / "meta" / "modality.json").read_text())
        info = json.loads((root / "meta" / "info.json").read_text())
        self.features: dict[str, Any] = info["features"]
        self.statistics = json.loads((root / "meta" / "stats.json").read_text())
        self.frames = pd.concat(pd.read_parquet(path) for path in sorted((root / "data").rglob("*.parquet")))
        tasks = pd.read_parquet(root / "meta" / "tasks.parquet")
        self.sentences = {int(row["task_index"]): str(text) for text, row in tasks.iterrows()}

    def part(self, kind: str, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return a part (frames, n) of state or action, and each of its statistics (n,)."""
        entry = self.modality[kind][name]
        column, where = entry.get("original_key", COLUMNS[kind]), slice(entry["start"], entry["end"])
        values = np.stack(self.frames[column].to_list())[:, where]
        return values, {each: np.array(self.statistics[column][each])[where] for each in STATISTICS}

    def video(self, name: str) -> tuple[str, dict[str, int]]:
        """Return the feature of a video, and its height, width and channels."""
        key = self.modality["video"][name].get("original_key", f"observation.images.{name}")
        feature = self.features[key]
        return key, {side: feature["shape"][feature["names"].index(side)] for side in ("height", "width", "channels")}

    def sentence(self, key: str, frame: int) -> str:
        """Return what ``annotation.<...>`` says in a frame."""
        assert key.startswith("annotation.")
        entry = self.modality["annotation"][key.removeprefix("annotation.")]
        return self.sentences[int(self.frames[entry.get("original_key", key)].iloc[frame])]
