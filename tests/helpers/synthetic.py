"""Random episodes of the right shapes, for tests of what is written, read, trained on and reported."""

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import FORMAT_VERSION, GenerationFacts, installed_versions


def make_episode(index: int, *, outcome: str = "success", length: int = 12, text: str = "Lift the box.") -> Episode:
    """Return the episode of that index: equal arguments, equal arrays."""
    rng = np.random.default_rng(index)
    width = len(observation.environment_names(get_task("LiftBox")))
    return Episode(
        task="LiftBox",
        task_text=text,
        index=index,
        seed=0,
        region="R1",
        outcome=outcome,
        stage="manipulation",
        state=rng.normal(size=(length, len(observation.STATE_NAMES))).astype(np.float32),
        environment_state=rng.normal(size=(length, width)).astype(np.float32),
        action=rng.uniform(command.LOWER, command.UPPER, size=(length, command.SIZE)).astype(np.float32),
        success=np.arange(length) >= length - 2 if outcome == "success" else np.zeros(length, dtype=bool),
        initial_state={"robot": [-0.5, 0.0, 0.1 * index], "object": [0.0, 0.0, 0.0]},
        length_s=length / 10,
        stage_ticks={"locomotion": 4, "manipulation": length - 4} if length > 4 else {},
        reason="" if outcome == "success" else "it slipped",
        digest=f"{index:064x}",
        retries=index % 3,
        success_strict=outcome == "success",
    )


def make_facts(**changes: object) -> GenerationFacts:
    """Return the facts of a small run; knobs of its variation, plain ones, may be named among the changes."""
    facts: dict = {
        "task": "LiftBox",
        "task_text": "Lift the box.",
        "region": "R1",
        "seed": 0,
        "demonstration_hash": "d" * 64,
        "controller_hash": "c" * 64,
        "model_hash": "m" * 64,
        "num_episodes": None,
        "num_attempts": 10,
        "block_size": 4,
        "keep_failures": False,
        "versions": installed_versions(),
        "format_version": FORMAT_VERSION,
    }
    return GenerationFacts.read(facts | changes)
