"""In-memory samples equal LeRobot's, padding and choice of episodes included."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from synthetic import make_episode

from lerobot_demohlm import dataset_files
from lerobot_demohlm.loading import InMemoryDataset


def opened(root: Path, **kwargs: Any) -> LeRobotDataset:
    if not root.exists():
        dataset_files.write_dataset(root, "local/name", [make_episode(index, length=5 + index) for index in range(4)])
    return LeRobotDataset("local/name", root=root, **kwargs)


@pytest.mark.parametrize("episodes", [None, [1, 3]])
def test_samples_equal_lerobots(tmp_path: Path, episodes: list[int] | None) -> None:
    deltas = {"action": [step / 10 for step in range(7)], "observation.state": [-0.2, 0.0]}
    reference = opened(tmp_path / "data", delta_timestamps=deltas, episodes=episodes)
    held = InMemoryDataset.of(reference)
    assert len(held) == len(reference)
    indices = [len(reference) - 1, *range(len(reference))]
    for index, sample in zip(indices, held.__getitems__(indices), strict=True):
        expected = reference[index]
        assert sample.keys() == expected.keys()
        for key, value in expected.items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(sample[key], value), key
                assert sample[key].dtype == value.dtype, key
            else:
                assert sample[key] == value
    assert torch.equal(held[2]["action"], reference[2]["action"])
    assert len(held[1:3]) == 2


def test_torchs_loader_collates_them(tmp_path: Path) -> None:
    held = InMemoryDataset.of(opened(tmp_path / "data", delta_timestamps={"action": [0.0, 0.1, 0.2]}))
    batch = next(iter(torch.utils.data.DataLoader(held, batch_size=8)))
    assert batch["action"].shape == (8, 3, 23)
    assert batch["action_is_pad"].shape == (8, 3)
    assert batch["task"] == ["Lift the box."] * 8
