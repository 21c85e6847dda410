"""Samples from memory equal LeRobot's, for each policy's time steps; other datasets stay LeRobot's own."""

import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, factory

from gym_demohlm.errors import PolicyError
from lerobot_demohlm import cli
from lerobot_demohlm.benchmarks.training import samples_per_s
from lerobot_demohlm.datasets import in_memory, writer
from lerobot_demohlm.datasets.facts import write_facts
from lerobot_demohlm.datasets.in_memory import RANGE_FLOOR, STD_FLOOR, InMemoryDataset
from lerobot_demohlm.policies.presets import POLICIES, get_preset, policy_config, train_config
from tests.helpers.synthetic import make_episode, make_facts


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of four episodes of 25 to 28 steps, about as long as a chunk."""
    root = tmp_path_factory.mktemp("loading") / "data"
    episodes = [make_episode(index, length=25 + index) for index in range(4)]
    writer.write_dataset(root, "local/name", episodes)
    write_facts(root, make_facts(num_attempts=4), [episode.record() for episode in episodes])
    return root


def both(root: Path, **kwargs: Any) -> tuple[LeRobotDataset, InMemoryDataset]:
    return LeRobotDataset("local/name", root=root, **kwargs), InMemoryDataset("local/name", root=root, **kwargs)


def assert_same(sample: dict, expected: dict) -> None:
    assert sample.keys() == expected.keys()
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(sample[key], value), key
            assert sample[key].dtype == value.dtype, key
        else:
            assert sample[key] == value


def deltas_of(policy: str, root: Path) -> dict[str, list[float]] | None:
    meta = LeRobotDataset("local/name", root=root).meta
    return factory.resolve_delta_timestamps(policy_config(get_preset(policy, "paper"), steps=10), meta)


@pytest.mark.parametrize("policy", POLICIES)
def test_samples_equal_lerobots(policy: str, root: Path) -> None:
    reference, held = both(root, delta_timestamps=deltas_of(policy, root), episodes=[1, 3])
    assert held.is_held
    assert len(held) == len(reference) == 26 + 28
    indices = [len(reference) - 1, *range(0, len(reference), 3), 25, 26]  # the borders of episodes are among them
    for index, sample in zip(indices, held.__getitems__(indices), strict=True):
        assert_same(sample, reference[index])
    assert_same(held[2], reference[2])
    assert_same(held[-1], reference[-1])
    for sample, index in zip(held[24:28], range(24, 28), strict=True):
        assert_same(sample, reference[index])


@pytest.mark.parametrize("deltas", [None, {"action": [0.0, 0.1, 2.0], "observation.state": [-0.2, 0.0]}])
@pytest.mark.parametrize("num_workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_batches_equal_lerobots(deltas: dict | None, num_workers: int, root: Path) -> None:
    batches = []
    for dataset in both(root, delta_timestamps=deltas):
        meta: Any = dataset.meta.episodes
        sampler = EpisodeAwareSampler(meta["dataset_from_index"], meta["dataset_to_index"], shuffle=True, seed=3)
        workers = {"num_workers": num_workers, "multiprocessing_context": "spawn"} if num_workers else {}
        batches.append(list(torch.utils.data.DataLoader(dataset, batch_size=50, sampler=sampler, **workers)))
    assert [len(batch["task"]) for batch in batches[1]] == [50, 50, 6]
    for theirs, ours in zip(*batches, strict=True):
        assert_same(ours, theirs)


def test_loose_samples_are_stacked_as_ever(root: Path) -> None:
    held = both(root)[1]
    batch = held.__getitems__([4, 9])
    assert_same(torch.utils.data.default_collate(list(batch)), batch.columns)


def test_statistics_are_of_the_chosen_episodes_and_have_a_floor(root: Path) -> None:
    reference, held = both(root, episodes=[0])
    states = torch.stack([held[index]["observation.state"] for index in range(25)]).numpy()
    stats: Any = held.meta.stats
    np.testing.assert_allclose(stats["observation.state"]["mean"], states.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(stats["observation.state"]["std"], states.std(axis=0), rtol=1e-4)
    assert stats["observation.state"]["count"] == 25
    assert not np.allclose(stats["observation.state"]["mean"], reference.meta.stats["observation.state"]["mean"])
    whole: Any = both(root)[1].meta.stats
    np.testing.assert_array_equal(whole["observation.state"]["mean"], reference.meta.stats["observation.state"]["mean"])
    spread = {
        "std": np.array([0.0, 1.0]),
        "mean": np.zeros(2),
        "min": np.array([0.5, -2.0]),
        "max": np.array([0.5, 3.0]),
    }
    floored = in_memory._floored({"observation.state": spread, "action": spread, "observation.images.head": spread})
    assert all(entry["std"].tolist() == [STD_FLOOR, 1.0] for entry in floored.values())
    assert all(entry["mean"].tolist() == [0.0, 0.0] for entry in floored.values())
    state = floored.pop("observation.state")
    assert state["min"].tolist() == [0.5 - RANGE_FLOOR / 2, -2.0]
    assert state["max"].tolist() == [0.5 + RANGE_FLOOR / 2, 3.0]
    for entry in floored.values():  # an action that is always the same stays it
        assert entry["max"].tolist() == [0.5, 3.0]


def test_statistics_of_many_frames_are_exact(root: Path) -> None:
    """In single precision, a sum of squares row by row loses most of a small deviation from a mean of 0.73."""
    held = both(root, episodes=[0])[1]
    values = np.random.default_rng(0).normal(0.73, 0.0215, (400_000, 3)).astype(np.float32)
    stats = held._stats({"action": values})["action"]
    np.testing.assert_allclose(stats["mean"], values.mean(axis=0, dtype=np.float64), rtol=1e-9)
    np.testing.assert_allclose(stats["std"], values.std(axis=0, dtype=np.float64), rtol=1e-6)


def test_other_datasets_are_left_alone(tmp_path: Path) -> None:
    writer.write_dataset(tmp_path / "data", "local/name", [make_episode(0)])
    reference, other = both(tmp_path / "data", delta_timestamps={"action": [0.0, 0.1]})
    assert not other.is_held
    assert_same(other[11], reference[11])
    assert_same(other.__getitems__([3])[0], reference[3])
    assert other.meta.stats.keys() == reference.meta.stats.keys()
    np.testing.assert_array_equal(other.meta.stats["action"]["std"], reference.meta.stats["action"]["std"])


def test_the_plugin_installs_it_and_the_switch_keeps_it_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "LeRobotDataset", LeRobotDataset)
    make = inspect.unwrap(factory.make_dataset)
    monkeypatch.setattr(factory, "make_dataset", make)
    monkeypatch.setenv(in_memory.SWITCH, "0")
    in_memory.install()
    assert factory.LeRobotDataset is LeRobotDataset
    assert factory.make_dataset is make
    monkeypatch.delenv(in_memory.SWITCH)
    in_memory.install()
    assert factory.LeRobotDataset is InMemoryDataset


@pytest.mark.parametrize("eval_split", [0.0, 0.5])
def test_a_training_on_a_held_dataset_starts_no_loading_processes(
    eval_split: float, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(factory, "LeRobotDataset", LeRobotDataset)
    monkeypatch.setattr(factory, "make_dataset", inspect.unwrap(factory.make_dataset))
    caplog.set_level("INFO")
    config = train_config(root, tmp_path / "train", "mlp", "paper", steps=10)
    config.num_workers, config.dataset.eval_split = 4, eval_split
    factory.make_train_eval_datasets(config)
    assert config.num_workers == 4
    in_memory.install()
    in_memory.install()  # as often as anybody likes
    dataset, _ = factory.make_train_eval_datasets(config)
    assert isinstance(dataset, InMemoryDataset)
    assert config.num_workers == 0
    assert caplog.text.count("num_workers=0 instead of 4") == 1


def test_loading_processes_of_other_datasets_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer.write_dataset(tmp_path / "data", "local/name", [make_episode(0)])
    monkeypatch.setattr(factory, "LeRobotDataset", LeRobotDataset)
    monkeypatch.setattr(factory, "make_dataset", inspect.unwrap(factory.make_dataset))
    in_memory.install()
    config = train_config(tmp_path / "data", tmp_path / "train", "mlp", "paper", steps=10)
    config.num_workers = 4
    factory.make_train_eval_datasets(config)
    assert config.num_workers == 4


@pytest.mark.slow
def test_it_is_fifty_times_as_quick(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", "loading", "--num-episodes", "20", "--rounds", "1"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["ratio_of_cpu_time"] > 50


@pytest.mark.slow
def test_a_training_is_quicker_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["benchmark", "training", "--policies", "mlp", "--num-episodes", "10", "--steps"]
    assert cli.main([*words, "1"]) == 2
    assert cli.main([*words, "8"]) == 0
    line = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (line["policy"], line["steps"]) == ("mlp", 8)
    assert line["ratio"] > 2
    with pytest.raises(PolicyError, match="lerobot-train that failed"):
        samples_per_s(tmp_path / "no.json", tmp_path / "out", in_memory=True)
