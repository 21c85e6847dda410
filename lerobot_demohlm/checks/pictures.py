"""Stored pictures and states that were simulated again -> where the pictures are not of these states.

Colour is compressed, and another graphics library draws edges otherwise. So a frame may deviate a little: colours by
``videos.TOLERANCE`` of 255 on average, and 2 % of the depths by more than 2 mm.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import Task
from gym_demohlm.timing import FPS
from gym_demohlm.variation import get_variation
from lerobot_demohlm.checks.difference import Difference
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.cameras import PictureFacts
from lerobot_demohlm.datasets.pictures import video_file
from lerobot_demohlm.datasets.reader import StoredEpisode
from lerobot_demohlm.datasets.tables import read_table
from lerobot_demohlm.datasets.variation import DataVariation

DEPTH_TOLERANCE = 0.002  # m
DEPTH_SHARE = 0.02  # of a frame's pixels that may deviate by more
POSE_TOLERANCE = 1e-4  # m, and of quaternions


class PictureCheck:
    """Draws states again and compares them with a dataset's videos.

    Args:
        root: Of the dataset.
        task: Its task.
        facts: Its ``meta/demohlm.json``.

    Attributes:
        recorder: To be called with the simulation at the start and after each step.

    Raises:
        SceneError: This machine has nothing to draw with.
    """

    def __init__(self, root: Path, task: Task, facts: dict[str, Any]) -> None:
        from lerobot_demohlm.generation.painting import Painter, StateRecorder  # loads lerobot and a graphics library

        self._root, self._seed = root, int(facts["seed"])
        self._facts = PictureFacts.read(facts)
        self._painter = Painter(task, self._facts, get_variation(DataVariation.read(facts).variation))
        self.recorder = StateRecorder()

    def compare(self, entries: Sequence[StoredEpisode], worlds: Sequence[int]) -> list[Difference]:
        """Return the first difference of each episode whose pictures are not those of its states.

        Args:
            entries: One a world, in the order of the worlds.
            worlds: Those to look at: where states differ, pictures do too.
        """
        found = [self._first(entries[world], world) for world in worlds]
        self.recorder.clear()
        return [difference for difference in found if difference is not None]

    def close(self) -> None:
        """Give the graphics contexts back."""
        self._painter.close()

    def _first(self, entry: StoredEpisode, world: int) -> Difference | None:
        states = [self.recorder.state(step, world) for step in range(len(entry))]
        drawn = self._painter.frames((self._seed, entry.attempt), states, self.recorder.conditions(world))
        keys = [camera.key(stream) for camera in self._facts.cameras for stream in camera.streams]
        places = [f"videos/{key}/{name}" for key in keys for name in ("chunk_index", "file_index", "from_timestamp")]
        (row,) = read_table(self._root / "meta" / "episodes", ("episode_index", *places), [entry.episode]).to_pylist()
        for camera in self._facts.cameras:
            stored = read_table(self._root / "data", ("episode_index", camera.pose_key), [entry.episode])
            poses = np.stack(stored.column(camera.pose_key).to_numpy())
            off = np.abs(poses - drawn[camera.pose_key]).max(axis=1)
            if (off > POSE_TOLERANCE).any():
                step = int(np.argmax(off > POSE_TOLERANCE))
                return _difference(entry, step, camera.pose_key, f"the camera's pose is off by {off[step]:.2g}")
        for key in keys:
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            first = round(row[f"videos/{key}/from_timestamp"] * FPS)
            try:
                frames = videos.read_frames(self._root / video_file(key, chunk, file), first, len(entry))
                for step, frame in enumerate(frames):
                    wrong = _deviation(frame, drawn[key][step])
                    if wrong:
                        return _difference(entry, step, key, wrong)
            except DatasetError as error:
                return _difference(entry, 0, key, str(error))
        return None


def _difference(entry: StoredEpisode, step: int, field: str, detail: str) -> Difference:
    return Difference(episode=entry.episode, attempt=entry.attempt, step=step, field=field, detail=detail)


def _deviation(stored: np.ndarray, drawn: np.ndarray) -> str:
    """Return in words why a frame is not the one that was drawn again; nothing where it is."""
    if stored.shape != drawn.shape:
        return f"a frame of {stored.shape}, drawn as {drawn.shape}"
    if stored.ndim == 3:
        mean = float(np.abs(stored.astype(np.float32) - drawn).mean())
        return "" if mean <= videos.TOLERANCE else f"deviates by {mean:.1f} of 255 on average"
    true = videos.depth_of_codes(videos.depth_codes(drawn))
    share = float((np.abs(stored - true) > DEPTH_TOLERANCE).mean())
    return "" if share <= DEPTH_SHARE else f"{share:.0%} of the depths deviate by more than {DEPTH_TOLERANCE} m"
