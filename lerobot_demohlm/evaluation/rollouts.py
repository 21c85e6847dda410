"""A LeRobot policy checkpoint and seeds -> rollouts of many worlds together, one record an episode.

An episode is a function of policy, task, region and seed, whatever is rolled out beside it and in whichever process:
the one that ``lerobot-eval`` gives for that seed (``batch_rows.py`` says why). A policy that draws random numbers to
act, as Diffusion does, gives others of the same distribution; its draws are seeded by the first seed of the batch.
"""

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.envs.rendering import HEIGHT, WIDTH
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import PolicyError, UnknownNameError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import judge
from gym_demohlm.variation import get_variation
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.policies.devices import require_device
from lerobot_demohlm.policies.training import checkpoint
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.processes import end_with_parent

NUM_WORLDS = 16  # at a time: as many as the rows that a policy is given at least, see batch_rows.py

OnStep = Callable[[DemoHLMVectorEnv, np.ndarray], None]
"""Called after the reset and after every step with the environment and (N,) bool, whose episodes are going on."""


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
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    preprocessor, postprocessor = make_pre_post_processors(
        config, pretrained_path=str(path), preprocessor_overrides={"device_processor": {"device": device}}
    )
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


def trained_task(path: Path, *, or_scored: bool = False) -> str | None:
    """Return the name of the task whose dataset a checkpoint was trained on; None where nothing tells it.

    Args:
        path: Its ``pretrained_model`` directory.
        or_scored: Where the dataset is not there, or has several tasks: take the task that training was scored on.
    """
    trained = _training(path)
    root = (trained.get("dataset") or {}).get("root")
    facts = Path(root) / "meta" / "demohlm.json" if root else None
    name = json.loads(facts.read_text()).get("task") if facts is not None and facts.is_file() else None
    if name is None and or_scored:
        name = (trained.get("env") or {}).get("task")
    try:
        return get_task(str(name)).name if name else None
    except UnknownNameError:
        return None


def _training(path: Path) -> dict[str, Any]:
    """Return the training configuration beside a checkpoint, empty where there is none."""
    file = path / "train_config.json"
    return json.loads(file.read_text()) if file.is_file() else {}


def _num_train_episodes(trained: dict[str, Any]) -> int | None:
    """Return how many episodes a training configuration names, if its dataset is still there."""
    dataset = trained.get("dataset") or {}
    if dataset.get("episodes"):
        return len(dataset["episodes"])
    info = Path(dataset["root"]) / "meta/info.json" if dataset.get("root") else None
    if info is None or not info.is_file() or dataset.get("eval_split"):
        return None
    return json.loads(info.read_text())["total_episodes"]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is rolled out, and how much of it together.

    Attributes:
        task: Name of the task.
        region: Initial region.
        num_worlds: Episodes rolled out together in a process.
        num_threads: Threads of the physics in a process.
        num_workers: Processes; more than one for a policy on the CPU only.
        perception: How observation and gaze see objects, see ``gym_demohlm.perception.settings``.
        controller: Name, path or hash of the whole-body controller.
        variation: How worlds differ: "none", "real" or "hard".
    """

    task: str
    region: str
    num_worlds: int = NUM_WORLDS
    num_threads: int = 1
    num_workers: int = 1
    perception: str = "exact"
    controller: str = DEFAULT
    variation: str = "none"

    def __post_init__(self) -> None:
        """Check names and counts."""
        get_task(self.task).region(self.region)
        object.__setattr__(self, "perception", str(PerceptionSettings.read(self.perception)))
        get_variation(self.variation)
        for name in ("num_worlds", "num_threads", "num_workers"):
            if getattr(self, name) < 1:
                raise PolicyError(f"{name}={getattr(self, name)}", "1 or more", f"correct --{name.replace('_', '-')}")

    def limited(self, count: int) -> "Setting":
        """Return the same with no more worlds than there are episodes."""
        return replace(self, num_worlds=min(self.num_worlds, max(1, count)))

    def batches(self, seeds: Sequence[int]) -> list[Sequence[int]]:
        """Cut seeds into what is rolled out together."""
        return [seeds[start : start + self.num_worlds] for start in range(0, len(seeds), self.num_worlds)]


def rollouts(
    loaded: LoadedPolicy, setting: Setting, seeds: Sequence[int], *, on_step: OnStep | None = None
) -> Iterator[Rollout]:
    """Yield one rollout an episode, in the order of the seeds.

    The worlds of a batch begin together and share the policy's action queue; those whose episode has ended wait for
    the last one at no cost.

    Args:
        loaded: The policy.
        setting: Task, region and how many at a time.
        seeds: One an episode.
        on_step: See ``OnStep``; with one worker only.
    """
    setting = setting.limited(len(seeds))
    for batch in roll_batches(loaded, setting, setting.batches(seeds), on_step=on_step):
        yield from batch


def roll_batches(
    loaded: LoadedPolicy, setting: Setting, batches: Sequence[Sequence[int]], *, on_step: OnStep | None = None
) -> Iterator[list[Rollout]]:
    """Yield the rollouts of each batch of at most ``setting.num_worlds`` seeds, in order; see ``rollouts``.

    Raises:
        PolicyError: Several workers for a policy that is not on the CPU, or that are to be watched.
    """
    if not batches:
        return
    if setting.num_workers == 1:
        with closing(_environment(loaded, setting)) as env:
            for seeds in batches:
                yield _batch(loaded, setting, env, seeds, on_step)
        return
    if loaded.policy.config.device != "cpu" or on_step is not None:
        raise PolicyError(f"num_workers={setting.num_workers} for {loaded.policy.config.device}", "1", "lower it")
    # Forked, workers have the policy and what was imported at once; it takes a process that runs no threads of torch.
    with ProcessPoolExecutor(
        min(setting.num_workers, len(batches)),
        mp_context=multiprocessing.get_context("fork"),
        initializer=_start_worker,
        initargs=(loaded, setting),
    ) as pool:
        yield from pool.map(_batch_in_worker, batches)


_worker: dict[str, Any] = {}


def _start_worker(loaded: LoadedPolicy, setting: Setting) -> None:
    import torch

    end_with_parent()
    torch.set_num_threads(1)
    _worker.update(loaded=loaded, setting=setting, env=_environment(loaded, setting))


def _batch_in_worker(seeds: Sequence[int]) -> list[Rollout]:
    return _batch(_worker["loaded"], _worker["setting"], _worker["env"], seeds, None)


def _environment(loaded: LoadedPolicy, setting: Setting) -> DemoHLMVectorEnv:
    from gymnasium.vector import AutoresetMode

    return DemoHLMVectorEnv(
        num_envs=setting.num_worlds,
        task=get_task(setting.task).name,
        obs_type="pixels_agent_pos" if loaded.needs_images else "state",
        image_size=_image_size(loaded),
        region=setting.region,
        perception=setting.perception,
        controller=setting.controller,
        variation=setting.variation,
        num_threads=setting.num_threads,
        autoreset_mode=AutoresetMode.DISABLED,
    )


def _image_size(loaded: LoadedPolicy) -> tuple[int, int]:
    """Return the width and height [px] of the pictures that a policy was trained on."""
    for feature in loaded.policy.config.image_features.values():
        return int(feature.shape[2]), int(feature.shape[1])
    return WIDTH, HEIGHT


def _batch(
    loaded: LoadedPolicy, setting: Setting, env: DemoHLMVectorEnv, seeds: Sequence[int], on_step: OnStep | None
) -> list[Rollout]:
    """Roll out one batch; worlds beyond the seeds rest."""
    import torch

    going = np.arange(env.num_envs) < len(seeds)
    padded = [*seeds, *[seeds[-1]] * (env.num_envs - len(seeds))]
    observation, infos = env.reset(seed=padded, options={"reset_mask": going})
    drawn = infos["initial_state"]
    starts = [
        {key: [float(value) for value in drawn[key][world]] for key in drawn if not key.startswith("_")}
        for world in range(len(seeds))
    ]
    loaded.policy.reset()
    torch.manual_seed(seeds[0])  # for policies that draw random numbers to act
    steps, clipped = np.zeros(env.num_envs, dtype=int), np.zeros(env.num_envs, dtype=int)
    if on_step is not None:
        on_step(env, going)
    while going.any():
        actions = act(loaded, observation, env.task_description)
        observation, _, terminated, truncated, infos = env.step(actions)
        steps += going
        clipped += np.where(going, infos["clipped"], 0)
        going = going & ~(terminated | truncated)
        if on_step is not None:
            on_step(env, going)
    return [
        Rollout(
            task=env.task,
            policy=loaded.kind,
            policy_hash=loaded.hash,
            num_train_episodes=loaded.num_train_episodes,
            train_seed=loaded.train_seed,
            region=env.region,
            seed=seed,
            success_ever=bool(infos["success_ever"][world]),
            success_end=bool(infos["success"][world]),
            success_held=bool(infos["success_held"][world]),
            outcome=_outcome(
                {name: bool(infos[name][world]) for name in infos if not name.startswith("_")},
                get_task(env.task).failures,
            ),
            length_s=round(int(steps[world]) / env.metadata["render_fps"], 1),
            clipped=int(clipped[world]),
            perception=env.perception,
            perception_faults=env.perception_faults(world),
            initial_state=starts[world],
            variation=env.sim.variation.name,
            success_strict=bool(infos["success_strict"][world]),
            controller=provenance.controller_hash(setting.controller),
            code=provenance.code_hash(),
        )
        for world, seed in enumerate(seeds)
    ]


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


def _outcome(flags: dict[str, bool], failures: Iterable[str]) -> str:
    """Return how an episode ended.

    Args:
        flags: Its last info.
        failures: Names of the task's failures.
    """
    faults = {name: flags[name] for name in ("fell", "collided", *failures)}
    faults["fell"] |= flags["unstable"]
    return judge.outcome(flags["success_held"], faults)
