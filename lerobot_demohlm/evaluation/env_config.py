"""``--env.type=demohlm --env.task=LiftBox-v0`` -> Gymnasium environments, batched in one process or one a process."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

import gym_demohlm  # noqa: F401  registers the environments
from gym_demohlm.control import command
from gym_demohlm.control.controllers import DEFAULT, find
from gym_demohlm.envs import observation
from gym_demohlm.envs.episode import OBSERVATION_TYPES
from gym_demohlm.envs.rendering import HEIGHT, WIDTH
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import environment_id, get_task
from gym_demohlm.task import DEFAULT_REGION, Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.evaluation.batch_rows import row_processors

CAMERA = "head"


@EnvConfig.register_subclass("demohlm")
@dataclass
class DemoHLMEnvConfig(EnvConfig):
    """The environments of one task, or of several given as ``LiftBox-v0,PushCube-v0``."""

    task: str | None = "LiftBox-v0"
    fps: int = 10
    region: str = DEFAULT_REGION
    """Initial region: R1, R2, R3 or R4."""
    perception: str = "exact"
    """How observation and gaze see objects, such as exact, model, or rgbd,masks=color: see docs/perception.md."""
    controller: str = DEFAULT
    """Whole-body controller: its name, path or hash, as `demohlm controllers` lists them."""
    variation: str = "none"
    """How worlds differ from episode to episode: none, real or hard, or groups of them such as real:objects+pushes."""
    obs_type: str = "state"
    """"state", or "pixels_agent_pos" to add the head camera's image."""
    image_width: int = WIDTH
    """Width of the image [px]. A policy needs that of its training's pictures."""
    image_height: int = HEIGHT
    """Height of the image [px]. A policy needs that of its training's pictures."""
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the names and fill the feature tables from the environment's."""
        if self.obs_type not in OBSERVATION_TYPES:
            raise UnknownNameError("obs_type", self.obs_type, OBSERVATION_TYPES)
        if min(self.image_width, self.image_height) < 1:
            raise ValueError(f"got images of {self.image_width} x {self.image_height} pixels; expected 1 or more each")
        find(self.controller)
        self.perception = str(PerceptionSettings.read(self.perception))
        self.variation = get_variation(self.variation).name
        widths = set()
        for task in self.tasks:
            task.region(self.region)
            widths.add(len(observation.environment_names(task)))
        if len(widths) > 1:
            raise ValueError(
                f"got tasks {self.task} with environment states of {sorted(widths)} numbers; expected one size, as a "
                "policy has; evaluate them one by one"
            )
        vectors = {
            "agent_pos": (FeatureType.STATE, (len(observation.STATE_NAMES),), OBS_STATE),
            "environment_state": (FeatureType.ENV, (widths.pop(),), OBS_ENV_STATE),
            ACTION: (FeatureType.ACTION, (command.SIZE,), ACTION),
        }
        if self.obs_type == "pixels_agent_pos":
            vectors[f"pixels/{CAMERA}"] = self._picture()
        self.features = {key: PolicyFeature(type=kind, shape=shape) for key, (kind, shape, _) in vectors.items()}
        self.features_map = {key: name for key, (_, _, name) in vectors.items()}

    def _picture(self) -> tuple[FeatureType, tuple[int, int, int], str]:
        return FeatureType.VISUAL, (self.image_height, self.image_width, 3), f"{OBS_IMAGES}.{CAMERA}"

    @property
    def tasks(self) -> list[Task]:
        """The tasks named by ``task``."""
        return [get_task(name.strip()) for name in (self.task or "").split(",")]

    @property
    def gym_id(self) -> str:
        """Gymnasium id of the first task."""
        return environment_id(self.tasks[0].name)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What the environments are made with."""
        return {
            "obs_type": self.obs_type,
            "render_mode": self.render_mode,
            "region": self.region,
            "perception": self.perception,
            "image_size": (self.image_width, self.image_height),
            "controller": self.controller,
            "variation": self.variation,
        }

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return what LeRobot's evaluation does to observations and actions: see ``batch_rows.py``."""
        return row_processors()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return ``{task: {0: environments}}``.

        Args:
            n_envs: Worlds a task.
            use_async_envs: One process a world, as LeRobot's default. Otherwise the worlds are stepped together in this
                process, with the same results in less time and memory, and one whose episode has ended costs nothing.
        """
        return {task.name: {0: self._vector_env(task, n_envs, use_async_envs)} for task in self.tasks}

    def _vector_env(self, task: Task, n_envs: int, use_async_envs: bool) -> gym.vector.VectorEnv:
        identifier = environment_id(task.name)
        if use_async_envs and n_envs > 1:
            # "module:id" makes a worker import what registers the task, and neither torch nor lerobot.
            make = partial(
                gym.make,
                f"{task.module}:{identifier}",
                disable_env_checker=self.disable_env_checker,
                **self.gym_kwargs,
            )
            return gym.vector.AsyncVectorEnv(
                [make] * n_envs, context="forkserver", autoreset_mode=gym.vector.AutoresetMode.SAME_STEP
            )
        return gym.make_vec(
            identifier,
            num_envs=n_envs,
            vectorization_mode=gym.VectorizeMode.VECTOR_ENTRY_POINT,
            autoreset_mode=gym.vector.AutoresetMode.DISABLED,  # LeRobot looks at one episode a world, then resets all
            **self.gym_kwargs,
        )
