"""The film of what the tracker sees: as many frames as the longest episode, tasks side by side."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.task import Task
from lerobot_demohlm.benchmarks import perception_film
from lerobot_demohlm.benchmarks.perception_film import Film, draw


def test_a_film_shows_each_task_at_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = {"LiftBox": 3, "GraspCube": 5, "PushCube": 2}
    red, green, blue, none = [200, 0, 0], [0, 200, 0], [0, 0, 200], [0, 0, 0]
    colours = dict(zip(lengths, (red, green, blue), strict=True))

    def drawn(task: Task, *how: object) -> Iterator[np.ndarray]:
        assert how == ("R2", 4, 1, 3)
        for count in range(lengths[task.name]):
            yield np.full((480, 640, 3), np.array(colours[task.name]) + 10 * count, np.uint8)

    monkeypatch.setattr(perception_film, "drawn", drawn)
    path = tmp_path / "new/film.webp"
    asked = Film(output=path, tasks=tuple(lengths), region="R2", seed=4, index=1, stride=3, width=80, quality=100)
    assert draw(asked) == 5
    with Image.open(path) as film:
        for step in range(5):
            film.seek(step)
            shown = np.asarray(film.convert("RGB")).astype(int)
            for (row, column), (name, colour) in zip(((0, 0), (0, 1), (1, 0)), colours.items(), strict=True):
                middle = shown[60 * row + 30, 80 * column + 40]
                np.testing.assert_allclose(middle, np.array(colour) + 10 * min(step, lengths[name] - 1), atol=6)
            np.testing.assert_allclose(shown[90, 120], none, atol=6)


def test_a_task_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="LiftBoxes"):
        draw(Film(output=tmp_path / "film.webp", tasks=("LiftBoxes",)))
    assert not list(tmp_path.iterdir())
