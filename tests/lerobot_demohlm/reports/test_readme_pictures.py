"""The README's pictures: they show what was asked for, and those in the repository are of every task."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm.reports import films, readme_pictures
from lerobot_demohlm.reports.films import Take
from lerobot_demohlm.reports.readme_pictures import FILM_LAST_MS, MOMENTS, Moment, View
from tests.helpers.paths import REPOSITORY

PICTURES = REPOSITORY / "docs" / "pictures"


@pytest.fixture(scope="module")
def take() -> Take:
    return films.generated_take(get_task("LiftBox"), "R1", seed=7, index=1)


@pytest.fixture(autouse=True)
def cheap_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readme_pictures, "SHADOW_SIZE", 256)


def test_a_camera_looks_over_the_shoulder_or_at_the_face() -> None:
    """An azimuth of 0 puts the camera behind a robot that faces the world's y axis, 180 before it."""
    T_world_pelvis = np.eye(4)
    T_world_pelvis[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    for azimuth, behind in ((0.0, True), (180.0, False)):
        camera = View(azimuth_deg=azimuth, elevation_deg=0.0, towards=0.0).camera(T_world_pelvis, np.zeros(3))
        direction = np.radians(camera.azimuth)
        eye = camera.lookat[:2] - camera.distance * np.array([np.cos(direction), np.sin(direction)])
        assert (eye[1] < 0) == behind
        assert abs(eye[0]) < 1e-9


def test_a_thumbnail_shows_its_moment(take: Take) -> None:
    early, late = (readme_pictures.thumbnail(take, Moment(share=share), 64) for share in (0.0, 1.0))
    assert early.size == (64, 48)
    assert np.asarray(early).std() > 10  # a picture of something
    assert not np.array_equal(np.asarray(early), np.asarray(late))


def test_a_film_shows_takes_side_by_side(take: Take, tmp_path: Path) -> None:
    long, short = (dataclasses.replace(take, snapshots=take.snapshots[::step]) for step in (25, 50))
    frames = readme_pictures.film([long, short], 48)
    assert {frame.size for frame in frames} == {(96, 36)}
    assert len(frames) == len(range(0, len(long.snapshots) + 1, readme_pictures.FILM_STRIDE))
    halves = [np.asarray(frame)[:, 48:] for frame in frames]
    last = next(
        index for index in range(len(halves)) if index * readme_pictures.FILM_STRIDE >= len(short.snapshots) - 1
    )
    assert all(np.array_equal(half, halves[last]) for half in halves[last:])  # the shorter one keeps its last picture
    assert not np.array_equal(halves[0], halves[last])
    readme_pictures.write_film(frames, tmp_path / "film.webp", quality=50)
    with Image.open(tmp_path / "film.webp") as film:
        assert getattr(film, "n_frames", 1) == len(frames)
        film.seek(len(frames) - 1)
        film.load()
        assert film.info["duration"] == FILM_LAST_MS


def test_the_pictures_of_the_repository_are_of_every_task() -> None:
    packaged = {task.name for task in all_tasks().values() if task.module.startswith("gym_demohlm.tasks")}
    assert set(MOMENTS) == packaged
    shown = {path.stem for path in PICTURES.glob("*.webp") if not path.stem.startswith("teleop_")}
    assert shown == {get_task(name).slug for name in packaged} | {"film"}
    with Image.open(PICTURES / readme_pictures.FILM_NAME) as film:
        assert getattr(film, "n_frames", 1) > 30
