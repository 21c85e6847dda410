"""A dataset -> samples a second from LeRobot's loader and from memory, measured in turns in one process."""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import FPS
from lerobot_demohlm.datasets.facts import GenerationFacts, write_facts
from lerobot_demohlm.datasets.variation import PLAIN

TASK, LENGTH = "LiftBox", 130  # of random episodes, about as long as real ones [steps]


def write_random_dataset(root: Path, num_episodes: int) -> None:
    """Write a dataset of random numbers with the columns and the size of a generated one."""
    from lerobot_demohlm.datasets.episode import Episode
    from lerobot_demohlm.datasets.writer import write_dataset

    rng, task = np.random.default_rng(0), get_task(TASK)
    widths = {
        "state": len(observation.STATE_NAMES),
        "environment_state": len(observation.environment_names(task)),
        "action": command.SIZE,
    }
    episodes = []
    for index in range(num_episodes):
        arrays: dict[str, Any] = {
            name: rng.normal(size=(LENGTH, width)).astype(np.float32) for name, width in widths.items()
        }
        episodes.append(
            Episode(
                task=task.name,
                task_text=task.description,
                index=index,
                seed=0,
                region="R1",
                outcome="success",
                stage="manipulation",
                success=np.ones(LENGTH, dtype=bool),
                initial_state=task.default_state(),
                length_s=LENGTH / FPS,
                **arrays,
            )
        )
    write_dataset(root, "local/random", episodes)
    hashes = dict.fromkeys(("demonstration_hash", "controller_hash", "model_hash"), "0" * 64)
    facts = GenerationFacts(
        task=task.name,
        task_text=task.description,
        region="R1",
        seed=0,
        num_episodes=None,
        num_attempts=num_episodes,
        block_size=num_episodes,
        keep_failures=False,
        variation=PLAIN,
        **hashes,
    )
    write_facts(root, facts, [episode.record() for episode in episodes])


def measure(root: Path, *, chunk: int, batch_size: int, rounds: int, batches: int) -> dict[str, Any]:
    """Return samples a second of both, and how many times more ours are.

    Args:
        root: Dataset.
        chunk: Actions a sample.
        batch_size: Samples a batch.
        rounds: Turns of both.
        batches: Batches a turn from memory; LeRobot's loader gets one.
    """
    import torch
    from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
    from lerobot.utils.utils import cycle

    from lerobot_demohlm.datasets.in_memory import InMemoryDataset

    torch.set_num_threads(1)
    deltas = {"action": [step / FPS for step in range(chunk)]}
    loaders: dict[str, Callable[[], Any]] = {}
    for name, kind in (("lerobot", LeRobotDataset), ("memory", InMemoryDataset)):
        dataset = kind("local/measured", root=root, delta_timestamps=deltas)
        meta: Any = dataset.meta.episodes
        sampler = EpisodeAwareSampler(meta["dataset_from_index"], meta["dataset_to_index"], shuffle=True, seed=0)
        iterator = cycle(torch.utils.data.DataLoader(dataset, batch_size=batch_size, sampler=sampler))
        loaders[name] = iterator.__next__
    seconds = dict.fromkeys(loaders, 0.0)
    cpu_seconds = dict.fromkeys(loaders, 0.0)
    samples = dict.fromkeys(loaders, 0)
    for turn in range(rounds + 1):
        for name, load in loaders.items():
            wall, cpu = time.perf_counter(), time.process_time()
            loaded = sum(len(load()["index"]) for _ in range(1 if name == "lerobot" else batches))
            if turn:  # the first is for warming up
                seconds[name] += time.perf_counter() - wall
                cpu_seconds[name] += time.process_time() - cpu
                samples[name] += loaded
    per_cpu_second = {name: samples[name] / cpu_seconds[name] for name in loaders}
    return {
        "chunk": chunk,
        "batch_size": batch_size,
        "lerobot_samples_per_s": round(samples["lerobot"] / seconds["lerobot"], 1),
        "memory_samples_per_s": round(samples["memory"] / seconds["memory"], 1),
        "ratio": round(samples["memory"] / seconds["memory"] / (samples["lerobot"] / seconds["lerobot"]), 1),
        "ratio_of_cpu_time": round(per_cpu_second["memory"] / per_cpu_second["lerobot"], 1),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark loading``."""
    parser.add_argument("--root", type=Path, help="dataset of `demohlm generate` (default: one of random numbers)")
    parser.add_argument("--num-episodes", type=int, default=100, help="of random numbers (default: %(default)s)")
    parser.add_argument("--chunk", type=int, default=20, help="actions a sample (default: %(default)s)")
    parser.add_argument("--batch-size", type=int, default=512, help="samples a batch (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of both (default: %(default)s)")
    parser.add_argument("--batches", type=int, default=20, help="from memory, a turn (default: %(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: A count is not positive.
    """
    counts = {name: getattr(arguments, name) for name in ("chunk", "batch_size", "rounds", "batches")}
    for name, value in {**counts, "num_episodes": arguments.num_episodes}.items():
        if value < 1:
            raise DatasetError(f"{name}={value}", "1 or more", f"correct --{name.replace('_', '-')}")
    with tempfile.TemporaryDirectory() as scratch:
        root = arguments.root
        if root is None:
            root = Path(scratch) / "random"
            write_random_dataset(root, arguments.num_episodes)
        print(json.dumps(measure(root, **counts)))
