"""A policy -> rollouts an hour by ``lerobot-eval`` as a user calls it and by ``demohlm evaluate``, same seeds."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.default import EvalConfig

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import PolicyError
from gym_demohlm.registry import get_task
from gym_demohlm.task import Task
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, evaluate
from lerobot_demohlm.evaluation.loaded_policy import load_policy
from lerobot_demohlm.evaluation.rollouts import Setting


def write_standing_policy(path: Path, task: Task) -> Path:
    """Write a checkpoint of the MLP that stands still until the time is up: no weights, the mean action is to rest."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig
    from lerobot_demohlm.policies.chunked_mlp.modeling_chunked_mlp import ChunkedMLPPolicy
    from lerobot_demohlm.policies.chunked_mlp.processor_chunked_mlp import make_chunked_mlp_pre_post_processors

    config = ChunkedMLPConfig(device="cpu", push_to_hub=False)
    widths = {
        "observation.state": (FeatureType.STATE, len(observation.STATE_NAMES)),
        "observation.environment_state": (FeatureType.ENV, len(observation.environment_names(task))),
    }
    config.input_features = {key: PolicyFeature(type=kind, shape=(width,)) for key, (kind, width) in widths.items()}
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(command.SIZE,))}
    policy = ChunkedMLPPolicy(config)
    for parameter in policy.parameters():
        torch.nn.init.zeros_(parameter)
    stats = {key: {"mean": np.zeros(width), "std": np.ones(width)} for key, (_, width) in widths.items()}
    stats["action"] = {"mean": command.rest(), "std": np.ones(command.SIZE)}
    for part in (policy, *make_chunked_mlp_pre_post_processors(config, stats)):
        part.save_pretrained(path)
    return path


def lerobots(
    policy: Path, task: str, region: str, num_episodes: int, batch_size: int | None, scratch: Path
) -> tuple[float, list[bool]]:
    """Return what ``lerobot-eval`` says that its rollouts took [s], without its start, and their successes."""
    words = [
        str(Path(sys.executable).parent / "lerobot-eval"),
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--env.type=demohlm",
        f"--env.task={task}",
        f"--env.region={region}",
        f"--eval.n_episodes={num_episodes}",
        f"--seed={FIRST_SEED}",
        f"--output_dir={scratch / 'lerobot'}",
    ]
    words += [] if batch_size is None else [f"--eval.batch_size={batch_size}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    file = scratch / "lerobot" / "eval_info.json"
    if done.returncode != 0 or not file.is_file():
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise PolicyError(f"lerobot-eval that failed ({last})", "rollouts", "run it by hand")
    info = json.loads(file.read_text())
    successes = [success for task_info in info["per_task"] for success in task_info["metrics"]["successes"]]
    return info["overall"]["eval_s"], successes


def _made(num_episodes: int, batch_size: int | None) -> int:
    """Return how many rollouts ``lerobot-eval`` makes: whole batches, of which it leaves out what is too much."""
    size = EvalConfig(n_episodes=num_episodes, batch_size=batch_size or 0).batch_size
    return -(-num_episodes // size) * size


def measure(
    policy: Path, setting: Setting, num_episodes: int, num_lerobot_episodes: int, lerobot_batch_size: int | None = None
) -> dict[str, Any]:
    """Return rollouts an hour of both, and whether they agree on the episodes that both have.

    Args:
        policy: ``pretrained_model`` of a checkpoint.
        setting: Task, region and how ours are rolled out.
        num_episodes: Rollouts of ours.
        num_lerobot_episodes: Rollouts of LeRobot's, the first of ours. It draws pictures of the first ten.
        lerobot_batch_size: How many of them at a time; LeRobot chooses by default.
    """
    with tempfile.TemporaryDirectory() as scratch:
        theirs_s, theirs = lerobots(
            policy, setting.task, setting.region, num_lerobot_episodes, lerobot_batch_size, Path(scratch)
        )
        loaded = load_policy(policy, setting.task)
        seeds = range(FIRST_SEED, FIRST_SEED + num_episodes)
        began = time.monotonic()
        rollouts = evaluate(loaded, setting, seeds, Path(scratch) / "rollouts.jsonl")
        ours_s = time.monotonic() - began
    made = _made(num_lerobot_episodes, lerobot_batch_size)
    both = list(zip(theirs, [rollout.success_held for rollout in rollouts], strict=False))
    return {
        "task": get_task(setting.task).name,
        "policy": loaded.kind,
        "mean_length_s": round(float(np.mean([rollout.length_s for rollout in rollouts])), 1),
        "num_workers": setting.num_workers,
        "num_worlds": setting.num_worlds,
        "lerobot_worlds": lerobot_batch_size or "as many as it chooses",
        "lerobot_rollouts_per_hour": round(3600 * made / theirs_s, 1),
        "rollouts_per_hour": round(3600 * num_episodes / ours_s, 1),
        "ratio": round(num_episodes / ours_s / (made / theirs_s), 2),
        "compared": len(both),
        "agreeing": sum(one == other for one, other in both),
    }
