"""Random episodes -> how much faster they are written than by LeRobot's own writer, and the memory of a long run.

Both write the same episodes, in turns; every column, statistic and entry of the metadata must be equal. Then a run of
thousands of episodes goes through the blocks of ``demohlm generate`` and their merge.
"""

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from datasets import disable_progress_bars
from lerobot.datasets import LeRobotDataset

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import FPS
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import ROBOT_TYPE, GenerationFacts
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.datasets.writer import data_file, episodes_file, features, write_dataset
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun

TASK, LENGTH = "LiftBox", 140  # of random episodes, about as long as real ones [steps]
BLOCK = 8  # episodes a dataset


def random_episode(index: int) -> Episode:
    """Return an episode of random walks with the columns and the length of a generated one."""
    rng, task = np.random.default_rng(index), get_task(TASK)

    def walk(width: int) -> np.ndarray:
        return (0.02 * rng.normal(size=(LENGTH, width))).cumsum(axis=0).astype(np.float32)

    return Episode(
        task=task.name,
        task_text=task.description,
        index=index,
        seed=0,
        region="R3",
        outcome="success",
        stage="manipulation",
        state=walk(len(observation.STATE_NAMES)),
        environment_state=walk(len(observation.environment_names(task))),
        action=walk(command.SIZE),
        success=np.arange(LENGTH) > 120,
        initial_state=task.default_state(),
        length_s=LENGTH / FPS,
    )


def write_with_lerobot(root: Path, episodes: Sequence[Episode]) -> tuple[float, float]:
    """Write episodes as LeRobot's documentation says; returns the CPU seconds of adding frames, and of the rest."""
    began = time.process_time()
    dataset = LeRobotDataset.create("local/random", FPS, features(TASK), root, ROBOT_TYPE, use_videos=False)
    adding = 0.0
    for episode in episodes:
        before = time.process_time()
        for step in range(LENGTH):
            dataset.add_frame(
                {
                    "observation.state": episode.state[step],
                    "observation.environment_state": episode.environment_state[step],
                    "action": episode.action[step],
                    "next.success": episode.success[step : step + 1],
                    "task": episode.task_text,
                }
            )
        adding += time.process_time() - before
        dataset.save_episode()
    dataset.finalize()
    return adding, time.process_time() - began - adding


def require_equal(ours: Path, theirs: Path) -> None:
    """Compare two datasets: columns, types, one row group an episode, statistics, metadata.

    Raises:
        DatasetError: Something differs, but for the columns that only our episodes have.
    """
    for path in (data_file(0), episodes_file(0), Path("meta/tasks.parquet")):
        mine, reference = pq.read_table(ours / path), pq.read_table(theirs / path)
        if not mine.select(reference.column_names).equals(reference):
            raise DatasetError(f"another {path} than LeRobot's", "the same content", "report a bug")
    groups = [pq.ParquetFile(root / data_file(0)).num_row_groups for root in (ours, theirs)]
    documents = [
        [json.loads((root / "meta" / name).read_text()) for name in ("info.json", "stats.json")]
        for root in (ours, theirs)
    ]
    if groups[0] != groups[1] or documents[0] != documents[1]:
        raise DatasetError("another metadata than LeRobot's", "the same content", "report a bug")


def measure_speed(rounds: int) -> dict[str, Any]:
    """Write blocks of episodes both ways, in turns; the first turn is for warming up."""
    ours = adding = saving = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(rounds + 1):
            episodes = [random_episode(BLOCK * turn + index) for index in range(BLOCK)]
            mine, reference = Path(scratch) / f"ours_{turn}", Path(scratch) / f"theirs_{turn}"
            began = time.process_time()
            write_dataset(mine, "local/random", episodes)
            seconds = time.process_time() - began
            frames, rest = write_with_lerobot(reference, episodes)
            require_equal(mine, reference)
            if turn:
                ours, adding, saving = ours + seconds, adding + frames, saving + rest
    count = rounds * BLOCK
    return {
        "episodes_per_s": round(count / ours, 1),
        "lerobot_episodes_per_s": round(count / (adding + saving), 1),
        "write_speedup": round(saving / ours, 1),
        "write_speedup_with_add_frame": round((adding + saving) / ours, 1),
    }


def measure_memory(num_episodes: int) -> dict[str, Any]:
    """Send episodes through blocks and merge and return what the process holds: early, after the last, at the peak."""
    hashes = dict.fromkeys(("demonstration_hash", "controller_hash", "model_hash"), "0" * 64)
    task = get_task(TASK)
    facts = GenerationFacts(
        task=task.name,
        task_text=task.description,
        region="R3",
        seed=0,
        num_episodes=None,
        num_attempts=num_episodes,
        block_size=BLOCK,
        keep_failures=False,
        variation=PLAIN,
        **hashes,
    )
    early = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        run = GenerationRun.open(Path(scratch) / "run", "local/random", facts)
        for attempts in run.pending_blocks():
            write_block(run.directory, facts, attempts, [random_episode(index) for index in attempts])
            if attempts.start < num_episodes / 10:
                early = _resident_mb()
        late = _resident_mb()
        began = time.process_time()
        run.finish()
        merging = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "run_episodes": num_episodes,
        "rss_after_a_tenth_mb": round(early),
        "rss_after_all_mb": round(late),
        "rss_peak_of_merge_mb": round(peak),
        "rss_growth_mb": round(late - early, 1),
        "merge_s": round(merging, 1),
    }


def _resident_mb() -> float:
    """Return the memory that this process holds now [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark dataset``."""
    parser.add_argument("--rounds", type=int, default=4, help=f"turns of {BLOCK} episodes each (default: %(default)s)")
    parser.add_argument("--run-episodes", type=int, default=5000, help="of the long run; 0 leaves it out (%(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: A count that makes no sense, or a difference to LeRobot's files.
    """
    if arguments.rounds < 1 or arguments.run_episodes < 0:
        raise DatasetError(
            f"rounds={arguments.rounds}, run_episodes={arguments.run_episodes}", "1 and 0 or more", "correct them"
        )
    disable_progress_bars()  # LeRobot's image step would draw one an episode
    memory = measure_memory(arguments.run_episodes) if arguments.run_episodes else {}
    print(json.dumps(measure_speed(arguments.rounds) | memory))
