"""A LeRobot policy and seeds -> rollouts of many worlds together, one record an episode.

An episode is a function of policy, task, region and seed, whatever is rolled out beside it and in whichever process:
the one that ``lerobot-eval`` gives for that seed (``batch_rows.py`` says why). A policy that draws random numbers to
act, as Diffusion does, gives others of the same distribution; its draws are seeded by the first seed of the batch.
"""

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.envs.rendering import HEIGHT, WIDTH
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import PolicyError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import judge
from gym_demohlm.variation import get_variation
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy, act
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.processes import end_with_parent

NUM_WORLDS = 16  # at a time: as many as the rows that a policy is given at least, see batch_rows.py

OnStep = Callable[[DemoHLMVectorEnv, np.ndarray], None]
"""Called after the reset and after every step with the environment and (N,) bool, whose episodes are going on."""


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
        variation: How worlds differ, see ``get_variation``; "none" where nothing does, as by "real@0".
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
        object.__setattr__(self, "variation", get_variation(self.variation).name)
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
            code=provenance.simulation_hash(get_task(env.task)),
        )
        for world, seed in enumerate(seeds)
    ]


def _outcome(flags: dict[str, bool], failures: Iterable[str]) -> str:
    """Return how an episode ended.

    Args:
        flags: Its last info.
        failures: Names of the task's failures.
    """
    faults = {name: flags[name] for name in ("fell", "collided", *failures)}
    faults["fell"] |= flags["unstable"]
    return judge.outcome(flags["success_held"], faults)
