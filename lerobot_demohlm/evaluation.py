"""A LeRobot policy checkpoint -> seeded rollouts -> one JSON line an episode, and rates with Wilson intervals."""

import argparse
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.errors import DatasetError, PolicyError
from gym_demohlm.task import get_task
from gym_demohlm.vector_env import DemoHLMVectorEnv
from lerobot_demohlm.dataset import OUTCOMES, count_outcomes

FIRST_SEED = 1_000_000
"""Rollouts draw their starts from this seed on. Generation draws from (seed, attempt) pairs: no start is shared."""
SUCCESSES = ("success_held", "success_end", "success_ever")

OnStep = Callable[[DemoHLMVectorEnv, np.ndarray], None]
"""Called after the reset and after every step with the environment and (N,) bool, whose episodes are going on."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy with its processors, and what a record says of it.

    Attributes:
        policy: LeRobot's policy, in evaluation mode.
        preprocessor: Raw batch -> the policy's input.
        postprocessor: The policy's output -> commands.
        kind: Type registered with LeRobot, such as "chunked_mlp".
        hash: SHA-256 of everything that decides its actions.
        num_train_episodes: Episodes it was trained on, where that is known.
        needs_images: Whether it looks through the head camera.
    """

    policy: Any
    preprocessor: Any
    postprocessor: Any
    kind: str
    hash: str
    num_train_episodes: int | None
    needs_images: bool


def policy_hash(path: Path) -> str:
    """Return the SHA-256 of a checkpoint: weights, configuration and processors, without what only training reads."""
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()):
        if file.suffix in (".safetensors", ".json") and file.name != "train_config.json":
            digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def load_policy(path: Path, task: str, device: str = "cpu") -> LoadedPolicy:
    """Load a checkpoint that ``lerobot-train`` wrote.

    Args:
        path: Its ``pretrained_model`` directory.
        task: Name of the task that it is to do.
        device: Where it runs.

    Raises:
        PolicyError: There is no checkpoint, or its inputs or outputs are not those of the task.
    """
    path = Path(path)
    for file in ("config.json", "model.safetensors"):
        if not (path / file).is_file():
            raise PolicyError(f"{path} without {file}", "a pretrained_model of lerobot-train", "check --policy")

    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import env_to_policy_features
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    import lerobot_demohlm
    from lerobot_demohlm.env_config import DemoHLMEnvConfig

    lerobot_demohlm.register()
    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[f"--device={device}"])
    except ValueError as error:
        raise PolicyError(f"{path}: {error}", "a policy of a known type", "install what registers it") from error
    known = env_to_policy_features(DemoHLMEnvConfig(task=task, obs_type="pixels_agent_pos"))
    for key, feature in {**(config.input_features or {}), **(config.output_features or {})}.items():
        if key not in known or tuple(feature.shape) != tuple(known[key].shape):
            offered = f"{key} {known[key].shape}" if key in known else f"one of {', '.join(known)}"
            raise PolicyError(f"a policy with {key} {feature.shape}", offered, f"train it on a dataset of {task}")
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    preprocessor, postprocessor = make_pre_post_processors(
        config, pretrained_path=str(path), preprocessor_overrides={"device_processor": {"device": device}}
    )
    return LoadedPolicy(
        policy=policy,
        preprocessor=preprocessor,
        postprocessor=postprocessor,
        kind=config.type,
        hash=policy_hash(path),
        num_train_episodes=_num_train_episodes(path),
        needs_images=bool(config.image_features),
    )


def _num_train_episodes(path: Path) -> int | None:
    """Return how many episodes the training configuration beside a checkpoint names, if its dataset is still there."""
    file = path / "train_config.json"
    if not file.is_file():
        return None
    dataset = json.loads(file.read_text())["dataset"]
    if dataset.get("episodes"):
        return len(dataset["episodes"])
    info = Path(dataset["root"]) / "meta/info.json" if dataset.get("root") else None
    if info is None or not info.is_file() or dataset.get("eval_split"):
        return None
    return json.loads(info.read_text())["total_episodes"]


def rollouts(
    loaded: LoadedPolicy,
    task: str,
    region: str,
    seeds: Sequence[int],
    *,
    num_worlds: int = 16,
    num_threads: int = 1,
    on_step: OnStep | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield one record an episode, in the order of the seeds.

    The worlds of a batch begin together and share the policy's action queue; those whose episode has ended wait for
    the last one at no cost. The policy sees as many rows in every batch, so that its rounding is the same in the last.

    Args:
        loaded: The policy.
        task: Name of the task.
        region: Initial region.
        seeds: One an episode.
        num_worlds: Episodes rolled out together.
        num_threads: Threads of the physics.
        on_step: See ``OnStep``.
    """
    from gymnasium.vector import AutoresetMode

    seeds = list(seeds)
    env = DemoHLMVectorEnv(
        num_envs=min(num_worlds, len(seeds)),
        task=get_task(task).name,
        obs_type="pixels_agent_pos" if loaded.needs_images else "state",
        region=region,
        num_threads=num_threads,
        autoreset_mode=AutoresetMode.DISABLED,
    )
    try:
        for start in range(0, len(seeds), env.num_envs):
            yield from _batch(loaded, env, seeds[start : start + env.num_envs], on_step)
    finally:
        env.close()


def rollouts_with_bar(
    loaded: LoadedPolicy, task: str, region: str, seeds: Sequence[int], *, on_step: OnStep | None = None, **kwargs: int
) -> Iterator[dict[str, Any]]:
    """Yield what ``rollouts`` yields, and show on stderr how far the batch at work has come."""
    from tqdm import tqdm

    with tqdm(total=len(seeds), desc="rollouts", unit="episode") as bar:
        yielded, steps = 0, 0

        def shown(env: DemoHLMVectorEnv, going: np.ndarray) -> None:
            nonlocal steps
            batch = min(env.num_envs, len(seeds) - yielded)
            bar.n = yielded + batch - int(going.sum())
            bar.set_postfix_str(f"{steps / env.metadata['render_fps']:.1f} s simulated")
            steps = steps + 1 if going.any() else 0
            if on_step is not None:
                on_step(env, going)

        for record in rollouts(loaded, task, region, seeds, on_step=shown, **kwargs):
            yielded += 1
            yield record


def _batch(
    loaded: LoadedPolicy, env: DemoHLMVectorEnv, seeds: list[int], on_step: OnStep | None
) -> Iterator[dict[str, Any]]:
    """Roll out one batch; worlds beyond the seeds rest."""
    going = np.arange(env.num_envs) < len(seeds)
    padded = [*seeds, *[seeds[-1]] * (env.num_envs - len(seeds))]
    observation, infos = env.reset(seed=padded, options={"reset_mask": going})
    drawn = infos["initial_state"]
    starts = [
        {key: [float(value) for value in drawn[key][world]] for key in drawn if not key.startswith("_")}
        for world in range(len(seeds))
    ]
    loaded.policy.reset()
    steps, clipped = np.zeros(env.num_envs, dtype=int), np.zeros(env.num_envs, dtype=int)
    if on_step is not None:
        on_step(env, going)
    while going.any():
        actions = _act(loaded, env, observation)
        observation, _, terminated, truncated, infos = env.step(actions)
        steps += going
        clipped += np.where(going, infos["clipped"], 0)
        going = going & ~(terminated | truncated)
        if on_step is not None:
            on_step(env, going)
    for world, seed in enumerate(seeds):
        yield {
            "task": env.task,
            "region": env.region,
            "seed": seed,
            "policy_type": loaded.kind,
            "policy_hash": loaded.hash,
            "num_train_episodes": loaded.num_train_episodes,
            "success_ever": bool(infos["success_ever"][world]),
            "success_end": bool(infos["success"][world]),
            "success_held": bool(infos["success_held"][world]),
            "outcome": _outcome({name: bool(infos[name][world]) for name in infos if not name.startswith("_")}),
            "length_s": round(int(steps[world]) / env.metadata["render_fps"], 1),
            "clipped": int(clipped[world]),
            "initial_state": starts[world],
        }


def _act(loaded: LoadedPolicy, env: DemoHLMVectorEnv, observation: dict[str, Any]) -> np.ndarray:
    """Return the policy's commands (N, 23) for the observations of all worlds."""
    import torch
    from lerobot.envs import preprocess_observation

    batch: dict[str, Any] = preprocess_observation(observation)
    batch["task"] = [env.task_description] * env.num_envs
    with torch.inference_mode():
        actions = loaded.postprocessor(loaded.policy.select_action(loaded.preprocessor(batch)))
    array = actions.to("cpu", torch.float32).numpy()
    if array.shape != (env.num_envs, command.SIZE):
        raise PolicyError(f"actions {array.shape}", f"({env.num_envs}, {command.SIZE})", "use a policy of this task")
    return array


def _outcome(flags: dict[str, bool]) -> str:
    """Name how an episode ended: held success first, then what went wrong worst."""
    if flags["success_held"]:
        return "success"
    if flags["fell"] or flags["unstable"]:
        return "fell"
    for name in ("dropped", "collided", "off_course"):
        if flags.get(name, False):
            return name
    return "timeout"


def wilson(successes: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the Wilson score interval of a rate, 95 % by default.

    Args:
        successes: How many.
        count: Of how many, at least 1.
        z: Quantile of the normal distribution.
    """
    if not 0 <= successes <= count or count < 1:
        raise ValueError(f"got {successes} successes of {count}; expected 0 to {count}, of 1 or more; count again")
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))  # min and max: rounding at 0 and 1


def summarize(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the success rates of rollouts with their intervals, and the count of each outcome."""
    content: dict[str, Any] = {"episodes": len(records)}
    for name in SUCCESSES:
        successes = sum(record[name] for record in records)
        low, high = wilson(successes, len(records))
        content[name] = {"rate": round(successes / len(records), 4), "interval": [round(low, 4), round(high, 4)]}
    return content | {"outcomes": count_outcomes(records)}


def write_records(path: Path, records: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Write records as they come, one JSON line each, and return them all.

    Raises:
        DatasetError: The file exists.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    written = []
    try:
        with path.open("x") as file:
            for record in records:
                file.write(json.dumps(record) + "\n")
                file.flush()
                written.append(record)
    except FileExistsError as error:
        raise DatasetError(f"the file {path}, which exists", "a new file", "choose another --output") from error
    return written


def read_records(path: Path) -> list[dict[str, Any]]:
    """Return the records of a file that ``write_records`` wrote.

    Raises:
        DatasetError: There is no such file, or it holds something else.
    """
    try:
        records = [json.loads(line) for line in Path(path).read_text().splitlines()]
        valid = bool(records) and all(record["outcome"] in OUTCOMES for record in records)
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} ({error})", "a file of `demohlm evaluate`", "check the path") from error
    if not valid:
        raise DatasetError(f"{path} without rollouts", "a file of `demohlm evaluate`", "check the path")
    return records


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm evaluate``."""
    parser.add_argument("--policy", type=Path, required=True, help="a pretrained_model directory of lerobot-train")
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument("--region", default="R3", help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--num-episodes", type=int, default=50, help="rollouts (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first rollout (default: %(default)s)")
    parser.add_argument("--num-worlds", type=int, default=16, help="rollouts at a time (default: %(default)s)")
    parser.add_argument("--num-threads", type=int, default=2, help="threads of the physics (default: %(default)s)")
    parser.add_argument("--output", type=Path, help="file for the JSON lines; must not exist (default: none)")
    parser.add_argument("--device", default="cpu", help="where the policy runs (default: %(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Roll a policy out; the last line on stdout is a summary as JSON."""
    if min(arguments.num_episodes, arguments.num_worlds, arguments.num_threads) < 1 or arguments.seed < 0:
        raise PolicyError(
            f"--num-episodes {arguments.num_episodes} --num-worlds {arguments.num_worlds} --seed {arguments.seed}",
            "at least one episode, world and thread, and a seed of 0 or more",
            "correct them",
        )
    if arguments.output is not None and arguments.output.exists():
        raise DatasetError(f"the file {arguments.output}, which exists", "a new file", "choose another --output")
    get_task(arguments.task).region(arguments.region)
    loaded = load_policy(arguments.policy, arguments.task, arguments.device)
    found = rollouts_with_bar(
        loaded,
        arguments.task,
        arguments.region,
        range(arguments.seed, arguments.seed + arguments.num_episodes),
        num_worlds=arguments.num_worlds,
        num_threads=arguments.num_threads,
    )
    records = list(found) if arguments.output is None else write_records(arguments.output, found)
    print(json.dumps({"task": get_task(arguments.task).name, "region": arguments.region, **summarize(records)}))
