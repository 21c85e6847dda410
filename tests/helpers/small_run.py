"""A generation run of three attempts at a task of which some succeed and some fail, made once for all tests."""

import dataclasses
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation.worlds import Worlds
from lerobot_demohlm.datasets.facts import GenerationFacts
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility import provenance

REGION, SEED, NUM_ATTEMPTS = "R1", 3, 3
SUCCEEDED, FAILED = (0,), (1, 2)  # attempts
_LIFT = get_task("LiftBox")


def _lifted_and_was_turned(sim: Worlds) -> np.ndarray:
    return _LIFT.success(sim) & (poses.yaw(sim.start_pose("box")) > 0.1)


TASK = dataclasses.replace(_LIFT, success=_lifted_and_was_turned)  # the model of LiftBox, and its demonstration


def generate(root: Path) -> None:
    """Generate the dataset at a root, its failed attempts beside it."""
    demonstration = demonstrations.load(task=TASK)
    facts = GenerationFacts(
        task=TASK.name,
        task_text=TASK.description,
        region=REGION,
        seed=SEED,
        demonstration_hash=demonstration.content_hash,
        controller_hash=provenance.controller_hash(),
        model_hash=provenance.model_hash(build_scene(TASK).model),
        num_episodes=None,
        num_attempts=NUM_ATTEMPTS,
        block_size=NUM_ATTEMPTS,
        keep_failures=True,
        variation=PLAIN,
    )
    attempts = Attempts(TASK, demonstration, REGION, SEED, NUM_ATTEMPTS, Settings(variation=PLAIN))
    run = GenerationRun.open(root, "user/small", facts)
    for block in run.pending_blocks():
        write_block(run.directory, facts, block, attempts.run(block))
    attempts.close()
    run.finish()
