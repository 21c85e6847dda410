"""Pictures from memory equal LeRobot's own, for one frame and for several; too many of them stay in their videos."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset

from lerobot_demohlm.datasets import held_pictures
from lerobot_demohlm.datasets.facts import write_facts
from lerobot_demohlm.datasets.in_memory import InMemoryDataset
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.runner import generate
from tests.helpers.drawn import write_drawn
from tests.helpers.synthetic import make_episode, make_facts

RGB, DEPTH = "observation.images.head", "observation.images.head_depth"


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of three episodes that nothing was simulated for."""
    root = write_drawn(tmp_path_factory.mktemp("held") / "data", num_episodes=3, size=32)
    write_facts(root, make_facts(num_attempts=3), [make_episode(index).record() for index in range(3)])
    return root


def assert_batches_equal(root: Path, **options: Any) -> None:
    """Assert that a loader gives LeRobot's batches, in another order than that of the frames."""
    batches = []
    for kind in (LeRobotDataset, InMemoryDataset):
        dataset = kind("local/name", root=root, **options)
        assert getattr(dataset, "is_held", True)
        meta: Any = dataset.meta.episodes
        chosen = dataset.episodes
        sampler = EpisodeAwareSampler(
            meta["dataset_from_index"], meta["dataset_to_index"], episode_indices_to_use=chosen, shuffle=True, seed=3
        )
        order = list(sampler) if chosen is None else list(range(len(dataset)))[::-3]
        batches.append(list(torch.utils.data.DataLoader(dataset, batch_size=7, sampler=order)))
    for theirs, ours in zip(*batches, strict=True):
        assert ours.keys() == theirs.keys()
        for key, value in theirs.items():
            if isinstance(value, torch.Tensor):
                assert value.dtype == ours[key].dtype and torch.equal(ours[key], value), key
            else:
                assert ours[key] == value


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"delta_timestamps": {RGB: [-0.2, 0.0], DEPTH: [0.0], "action": [0.0, 0.1]}},
        {"episodes": [0, 2], "delta_timestamps": {DEPTH: [-0.1, 0.0, 0.1]}},
        {"return_uint8": True},
        {"depth_output_unit": "m"},
    ],
)
def test_batches_with_pictures_equal_lerobots(options: dict[str, Any], drawn: Path) -> None:
    assert_batches_equal(drawn, **options)


def test_transforms_see_each_picture_but_no_depth(drawn: Path) -> None:
    assert_batches_equal(drawn, image_transforms=lambda image: 1.0 - image)


def test_statistics_of_pictures_are_those_of_the_chosen_episodes(drawn: Path) -> None:
    whole, one = (InMemoryDataset("local/name", root=drawn, episodes=chosen) for chosen in (None, [1]))
    for key in one.meta.video_keys:
        assert one.meta.stats[key]["count"] < whole.meta.stats[key]["count"]
        assert one.meta.stats[key]["mean"].shape == whole.meta.stats[key]["mean"].shape
    frames = torch.stack([one[index][RGB] for index in range(len(one))])
    mean = one.meta.stats[RGB]["mean"].ravel()
    np.testing.assert_allclose(mean, frames.mean(dim=(0, 2, 3)), atol=0.02)
    depths = torch.stack([one[index][DEPTH] for index in range(len(one))])
    assert float(depths.mean()) > 100.0, "in mm, as LeRobot gives them"
    np.testing.assert_allclose(one.meta.stats[DEPTH]["mean"].ravel(), depths.mean(), rtol=0.02)


def test_pictures_that_do_not_fit_stay_in_their_videos(drawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = InMemoryDataset("local/name", root=drawn)
    needed = held_pictures.needed_bytes(dataset)
    assert needed == len(dataset) * 32 * 32 * (3 + 2)
    one = InMemoryDataset("local/name", root=drawn, episodes=[1]).meta.stats
    monkeypatch.setattr(held_pictures, "free_bytes", lambda: needed / held_pictures.SHARE - 1.0)
    small = InMemoryDataset("local/name", root=drawn)
    assert not small.is_held
    monkeypatch.setattr(held_pictures, "free_bytes", lambda: 0.0)
    same = InMemoryDataset("local/name", root=drawn, episodes=[1])
    assert not same.is_held
    for key, entry in one.items():
        for name, value in entry.items():
            np.testing.assert_array_equal(same.meta.stats[key][name], value), "whatever memory is free"
    assert torch.equal(small[3][RGB], dataset[3][RGB])


def test_the_limit_of_a_container_counts(tmp_path: Path) -> None:
    for name, text in (("memory.max", "1000000"), ("memory.current", "600000"), ("memory.stat", "inactive_file 50000")):
        (tmp_path / name).write_text(text + "\n")
    assert held_pictures._free_of_container(tmp_path) == 450_000.0
    (tmp_path / "memory.max").write_text("max\n")
    assert held_pictures._free_of_container(tmp_path) == float("inf")
    assert held_pictures._free_of_container(tmp_path / "none") == float("inf")


@pytest.mark.slow
def test_batches_of_a_generated_dataset_equal_lerobots(tmp_path: Path) -> None:
    request = GenerationRequest(
        task="LiftBox", region="R1", seed=5, root=tmp_path / "data", num_attempts=2, variation=PLAIN, wordings=True,
        cameras=("head:48x32:rgb,depth", "overview:32x32:rgb"), show_progress=False,
    )  # fmt: skip
    generate(request)
    assert_batches_equal(tmp_path / "data", delta_timestamps={RGB: [-0.1, 0.0], "action": [0.0, 0.1]})
