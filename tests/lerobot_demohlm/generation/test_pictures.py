"""Datasets with pictures: the same states, the same bytes for any number of workers, pictures of these states."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from gym_demohlm.errors import SceneError
from gym_demohlm.perception.camera import head_intrinsics
from gym_demohlm.registry import get_task
from lerobot_demohlm.checks.verify import verify
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.pictures import video_file
from lerobot_demohlm.datasets.reader import ENVIRONMENT_STATE, read
from lerobot_demohlm.experiments.variants import VARIANTS
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.runner import generate

RGB, DEPTH = "observation.images.head", "observation.images.head_depth"


def _generate(root: Path, **options: object) -> Path:
    request = {"task": "LiftBox", "region": "R1", "seed": 0, "num_episodes": 3, "block_size": 2, "show_progress": False}
    generate(GenerationRequest(root=root, **{**request, **options}))  # pyright: ignore[reportArgumentType]
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of two blocks, the second cut in its middle."""
    folder = tmp_path_factory.mktemp("pictures")
    return _generate(folder / "data", cameras=("head:96x96:rgb,depth",), wordings=True)


def test_lerobot_reads_pictures_depths_and_wordings(root: Path) -> None:
    dataset = LeRobotDataset("local/data", root=root)
    assert dataset.meta.camera_keys == [RGB, DEPTH] and dataset.meta.depth_keys == [DEPTH]
    sample = dataset[len(dataset) - 1]
    assert sample[RGB].shape == (3, 96, 96) and sample[DEPTH].shape == (1, 96, 96)
    assert {dataset[int(first)]["task"] for first in dataset.meta.episodes["dataset_from_index"]} == {
        "Walk to the box and lift it with both hands.", "Lift the box with both hands.",
        "Go to the box and raise it between your palms.",
    }  # fmt: skip
    info = dataset.meta.features[RGB]["info"]["intrinsics"]
    assert info["fx"] == pytest.approx(head_intrinsics(96, 96).focal)


def test_worlds_that_vary_are_drawn_and_verified(tmp_path: Path) -> None:
    """The encoders' errors, by which a stored state is beside the one that is drawn, are no reason to refuse it."""
    made = _generate(tmp_path / "data", cameras=("head:64x64:rgb",), num_episodes=1, variation=VARIANTS["real"])
    assert verify(made, get_task("LiftBox")).identical


def test_the_box_is_in_the_pictures_where_the_states_have_it(root: Path) -> None:
    """The depth at the pixel onto which the box's middle projects is that of the box's face, in every frame."""
    known, checked = head_intrinsics(96, 96), 0
    for entry in read(root, [0, 2]):
        path = root / video_file(DEPTH, 0, entry.episode // 2)  # a block's episodes are in one file
        frames = list(videos.read_frames(path, 0, len(entry)))
        for frame, row in zip(frames, entry.columns[ENVIRONMENT_STATE], strict=True):
            x, y, z = row[:3]  # forward, left, up
            u, v = np.round(known.project(np.array([-y, -z, x]))).astype(int)
            if 2 <= u < 94 and 2 <= v < 94:
                checked += 1
                assert x - 0.24 < frame[v, u] < x + 0.01  # half the box's diagonal, or a hand before it
    assert checked > 100


def test_states_are_those_of_a_dataset_without_pictures(root: Path, tmp_path: Path) -> None:
    plain = _generate(tmp_path / "plain")
    for mine, theirs in zip(read(root, [0, 1, 2]), read(plain, [0, 1, 2]), strict=True):
        assert mine.digest == theirs.digest
        for name, values in theirs.columns.items():
            np.testing.assert_array_equal(mine.columns[name], values)
    assert not (plain / "videos").exists() and "pictures" not in (plain / "meta" / "demohlm.json").read_text()


@pytest.mark.slow
def test_any_number_of_workers_makes_the_same_files(root: Path, tmp_path: Path) -> None:
    again = _generate(tmp_path / "again", cameras=("head:96x96:rgb,depth",), wordings=True, num_workers=2)
    for path in sorted(root.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (again / path.relative_to(root)).read_bytes(), path


def test_verify_draws_again_and_finds_a_damaged_video(root: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    assert verify(copy, get_task("LiftBox"), [0]).identical
    path = copy / video_file(RGB, 0, 0)
    frames = list(videos.read_frames(path))
    with videos.VideoWriter(path, 96, 96, depth=False) as writer:
        for index, frame in enumerate(frames):
            writer.add(frame if index != 30 else frame[::-1])
    (found,) = verify(copy, get_task("LiftBox"), [0]).differences
    assert (found.field, found.step) == (RGB, 30)
    path.write_bytes(path.read_bytes()[:2000])
    (found,) = verify(copy, get_task("LiftBox"), [0]).differences
    assert found.field == RGB and "damaged" in found.detail


def test_without_graphics_nothing_is_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_graphics(*_: object) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr("mujoco.GLContext", no_graphics)
    monkeypatch.setattr("lerobot_demohlm.generation.runner.GenerationRun.open", no_graphics)  # it does not come to that
    with pytest.raises(SceneError, match="no graphics"):
        _generate(tmp_path / "none", cameras=("head:96x96:rgb",))
