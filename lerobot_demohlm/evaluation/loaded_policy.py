"""A LeRobot policy checkpoint -> a policy with its processors that gives commands; and what its training tells."""

import hashlib
import json
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.errors import PolicyError, UnknownNameError
from gym_demohlm.registry import get_task
from lerobot_demohlm.policies.devices import require_device
from lerobot_demohlm.policies.training import checkpoint


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy with its processors, and what a record says of it.

    Attributes:
        policy: LeRobot's policy, in evaluation mode.
        preprocessor: Raw batch -> the policy's input.
        postprocessor: The policy's output -> commands.
        env_preprocessor: What the environment does to observations before that.
        env_postprocessor: What it does to commands after that.
        kind: Type registered with LeRobot, such as "chunked_mlp".
        hash: SHA-256 of everything that decides its actions.
        num_train_episodes: Episodes it was trained on, where that is known.
        train_seed: Seed of its training, where that is known.
        needs_images: Whether it looks through the head camera.
    """

    policy: Any
    preprocessor: Any
    postprocessor: Any
    env_preprocessor: Any
    env_postprocessor: Any
    kind: str
    hash: str
    num_train_episodes: int | None
    train_seed: int | None
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
        PolicyError: There is no checkpoint or no such device, the policy was trained on another task, or its inputs or
            outputs are not those of the task.
    """
    path, within = Path(path), checkpoint(Path(path))
    for file in ("config.json", "model.safetensors"):
        if not (path / file).is_file():
            remedy = f"name {within}" if within.is_dir() else "check --policy"
            raise PolicyError(f"{path} without {file}", "a pretrained_model of lerobot-train", remedy)
    require_device(device)
    trained_on = trained_task(path)
    if trained_on not in (None, get_task(task).name):
        raise PolicyError(f"a policy trained on {trained_on}", f"one for {get_task(task).name}", "check --task")

    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import env_to_policy_features
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from safetensors import SafetensorError

    import lerobot_demohlm
    from lerobot_demohlm.evaluation.env_config import DemoHLMEnvConfig

    lerobot_demohlm.register()
    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[f"--device={device}"])
    except ValueError as error:
        raise PolicyError(f"{path}: {error}", "a policy of a known type", "install what registers it") from error
    env_config = DemoHLMEnvConfig(task=task, obs_type="pixels_agent_pos")
    known = env_to_policy_features(env_config)
    for key, feature in {**(config.input_features or {}), **(config.output_features or {})}.items():
        if key not in known or not _fits(key, tuple(feature.shape), tuple(known[key].shape)):
            offered = f"{key} {known[key].shape}" if key in known else f"one of {', '.join(known)}"
            raise PolicyError(f"a policy with {key} {feature.shape}", offered, f"train it on a dataset of {task}")
    try:
        policy = get_policy_class(config.type).from_pretrained(path, config=config)
        preprocessor, postprocessor = make_pre_post_processors(
            config, pretrained_path=str(path), preprocessor_overrides={"device_processor": {"device": device}}
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        said = str(error).partition("\n")[0]
        raise PolicyError(
            f"{path}, damaged ({said})", "a checkpoint that is whole", "restore or train it again"
        ) from error
    env_preprocessor, env_postprocessor = env_config.get_env_processors()
    trained = _training(path)
    return LoadedPolicy(
        policy=policy,
        preprocessor=preprocessor,
        postprocessor=postprocessor,
        env_preprocessor=env_preprocessor,
        env_postprocessor=env_postprocessor,
        kind=config.type,
        hash=policy_hash(path),
        num_train_episodes=_num_train_episodes(trained),
        train_seed=trained.get("seed"),
        needs_images=bool(config.image_features),
    )


def _fits(key: str, shape: tuple[int, ...], offered: tuple[int, ...]) -> bool:
    """Tell whether the environment can give a policy a feature; it draws pictures of any size."""
    return shape == offered or (key.startswith("observation.images.") and len(shape) == 3 and shape[0] == offered[0])


def act(loaded: LoadedPolicy, observation: dict[str, Any], description: str) -> np.ndarray:
    """Return the policy's commands (N, 23) for the observations of N worlds.

    Args:
        loaded: The policy; what it has still to carry out of its last chunks is its own memory.
        observation: As an environment gives it: "agent_pos" (N, 68), "environment_state" (N, 9k), "pixels".
        description: The task in words.

    Raises:
        PolicyError: The policy gives something else.
    """
    import torch
    from lerobot.envs import preprocess_observation
    from lerobot.utils.constants import ACTION

    count = len(observation["agent_pos"])
    batch: dict[str, Any] = preprocess_observation(observation)
    batch["task"] = [description] * count
    config = loaded.policy.config
    kind = torch.device(str(config.device)).type
    precision = torch.autocast(kind) if config.use_amp else nullcontext()  # as lerobot-eval
    with torch.inference_mode(), precision:
        batch = loaded.preprocessor(loaded.env_preprocessor(batch))
        actions = loaded.postprocessor(loaded.policy.select_action(batch))
        actions = loaded.env_postprocessor({ACTION: actions})[ACTION]
    array = actions.to("cpu", torch.float32).numpy()
    if array.shape != (count, command.SIZE):
        raise PolicyError(f"actions {array.shape}", f"({count}, {command.SIZE})", "use a policy of this task")
    return array


def trained_task(path: Path, *, or_scored: bool = False) -> str | None:
    """Return the name of the task whose dataset a checkpoint was trained on; None where nothing tells it.

    Args:
        path: Its ``pretrained_model`` directory.
        or_scored: Where the dataset is not there, or has several tasks: take the task that training was scored on.
    """
    trained = _training(path)
    root = (trained.get("dataset") or {}).get("root")
    facts = Path(root) / "meta" / "demohlm.json" if root else None
    name = object_in(facts).get("task") if facts is not None else None
    if name is None and or_scored:
        name = (trained.get("env") or {}).get("task")
    try:
        return get_task(str(name).rpartition(":")[2]).name if name else None  # a file has no module imported
    except UnknownNameError:
        return None


def _training(path: Path) -> dict[str, Any]:
    """Return the training configuration beside a checkpoint, empty where there is none."""
    file = path / "train_config.json"
    try:
        content = json.loads(file.read_text()) if file.is_file() else {}
    except ValueError as error:
        raise PolicyError(f"{file}, no JSON ({error})", "a training's configuration", "restore or remove it") from error
    if not isinstance(content, dict):
        raise PolicyError(f"{file}, damaged", "a training's configuration", "restore or remove it")
    return content


def object_in(file: Path) -> dict[str, Any]:
    """Return the JSON object that a file of the training dataset holds; empty where it is not there for this user.

    A checkpoint is as good without its dataset, which may be another user's, or damaged.
    """
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _num_train_episodes(trained: dict[str, Any]) -> int | None:
    """Return how many episodes a training configuration names, if its dataset is still there."""
    dataset = trained.get("dataset") or {}
    if dataset.get("episodes"):
        return len(dataset["episodes"])
    info = Path(dataset["root"]) / "meta/info.json" if dataset.get("root") else None
    if info is None or dataset.get("eval_split"):
        return None
    return object_in(info).get("total_episodes")
