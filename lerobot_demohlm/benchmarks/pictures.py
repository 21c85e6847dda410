"""Attempts at a task with and without pictures, in turns -> what pictures cost of a worker's CPU time, and where.

All that a worker does with a block is counted, in all of its threads: attempts, drawing, encoding, and writing the
successes as a LeRobot dataset. What a worker does once is not: compiling the scene, opening the graphics library.
"""

import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gym_demohlm.simulation import Simulation, make_pool
from gym_demohlm.task import Task
from lerobot_demohlm.benchmarks.stopwatch import Stopwatch
from lerobot_demohlm.datasets.cameras import PictureFacts
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.datasets.writer import write_dataset
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.painting import Painter, StateRecorder
from lerobot_demohlm.generation.request import BLOCK_SIZE
from lerobot_demohlm.generation.stages import Settings


def measure(task: Task, region: str, seed: int, num_attempts: int, cameras: Sequence[str]) -> dict[str, Any]:
    """Make each block twice, as a worker does, and return what both took.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        num_attempts: How many, 1 or more.
        cameras: As ``--cameras`` of ``demohlm generate`` has them, one or more.

    Raises:
        DatasetError: A camera is not of that form.
        SceneError: This machine has nothing to draw with.
    """
    os.environ.setdefault("LP_NUM_THREADS", "1")  # as in a worker, who draws with one thread
    sim = Simulation(task.at(region), BLOCK_SIZE, pool=make_pool(1))
    demonstration, settings = demonstrations.load(None, task), Settings(variation=PLAIN)
    recorder, watch = StateRecorder(), Stopwatch()
    plain = Attempts(task, demonstration, region, seed, settings=settings, sim=sim)
    recorded = Attempts(task, demonstration, region, seed, settings=settings, sim=sim, on_step=recorder)
    painter = Painter(task.at(region), PictureFacts.of(cameras, light=0.0, texture=0.0, camera_shift=0.0))
    plain.run([0])  # it loads what is loaded once
    watch.watch(painter, "frames", "drawing")
    watch.watch(painter, "paint", "painting")  # drawing, encoding and statistics
    spent, frames, successes = {"states": 0.0, "pictures": 0.0}, 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        for first in range(0, num_attempts, BLOCK_SIZE):
            block = range(first, min(first + BLOCK_SIZE, num_attempts))
            began = time.process_time()
            kept = [episode for episode in plain.run(block) if episode.outcome == "success"]
            if kept:
                write_dataset(Path(scratch, "states", str(first)), "local/block", kept)
            halfway = time.process_time()
            recorder.clear()
            episodes = recorded.run(block)
            drawn = painter.paint(episodes, recorder, Path(scratch, str(first)))
            kept = [episode for episode in episodes if episode.outcome == "success"]
            if kept:
                write_dataset(Path(scratch, "pictures", str(first)), "local/block", kept, drawn=drawn)
            spent["states"] += halfway - began
            spent["pictures"] += time.process_time() - halfway
            successes += len(kept)
            frames += sum(len(episode.success) for episode in kept)
    painter.close()
    plain.close()
    spent_drawing = {"": spent["pictures"] - spent["states"], **{f"{name}_": s for name, s in watch.seconds.items()}}
    return {
        "task": task.name,
        "region": region,
        "seed": seed,
        "cameras": list(cameras),
        "attempts": num_attempts,
        "successes": successes,
        "frames": frames,
        "cpu_s_states": round(spent["states"], 3),
        "cpu_s_with_pictures": round(spent["pictures"], 3),
        "ratio": round(spent["pictures"] / spent["states"], 3),
        **{f"{name}ms_per_frame": round(1e3 * s / frames, 3) if frames else None for name, s in spent_drawing.items()},
    }
