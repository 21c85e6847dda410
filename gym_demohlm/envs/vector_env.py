"""N worlds of one task in one process as a Gymnasium vector environment: the bits of N single ones, much cheaper.

``gym.make_vec("DemoHLM/LiftBox-v0", num_envs=16, vectorization_mode="vector_entry_point")``. Infos have the layout of
Gymnasium's ``SyncVectorEnv``, so that LeRobot's evaluation reads them.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from gym_demohlm.envs.env import check_render_mode, first_row
from gym_demohlm.envs.episode import EXACT, RunningEpisodes, action_space, initial_state, observation_space
from gym_demohlm.envs.rendering import HEIGHT, WIDTH
from gym_demohlm.errors import SceneError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Controller, Simulation
from gym_demohlm.task import DEFAULT_REGION, InitialState
from gym_demohlm.timing import STEP_DT

RENDER_MODES = ("rgb_array",)


class DemoHLMVectorEnv(gym.vector.VectorEnv):
    """N worlds stepped together.

    Args:
        num_envs: N.
        task: Name of the task.
        obs_type: "state", or "pixels_agent_pos" to add the head camera's images.
        render_mode: None or "rgb_array".
        region: Initial region from which ``reset`` draws.
        num_threads: Threads of the physics.
        autoreset_mode: SAME_STEP begins the next episode in the step that ended one; DISABLED leaves a world whose
            episode ended as it is, at no cost, until ``reset``.
        controller: For N worlds, or its name, path or hash (`demohlm controllers`); the default one by default.
        perception: How observation and gaze see objects: "exact", "rgbd", "rgbd,masks=color" ... (docs/perception.md).
        image_size: Width and height of the head camera's images [px]. Smaller ones are drawn as datasets' pictures are.
        variation: How worlds differ from episode to episode: "none", "real" or "hard" (docs/variation.md).

    Raises:
        UnknownNameError: No such task, region, obs_type, render_mode, perception or variation.
        SceneError: Another autoreset mode.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / STEP_DT)}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "LiftBox",
        obs_type: str = "state",
        render_mode: str | None = None,
        region: str = DEFAULT_REGION,
        num_threads: int = 1,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        controller: Controller | str | None = None,
        perception: str | PerceptionSettings = EXACT,
        image_size: tuple[int, int] = (WIDTH, HEIGHT),
        variation: str = "none",
    ) -> None:
        check_render_mode(render_mode, RENDER_MODES)
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise SceneError(f"autoreset_mode={autoreset_mode}", "SAME_STEP or DISABLED", "choose one of these")
        definition = get_task(task).at(region)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "autoreset_mode": autoreset_mode}
        self.task, self.task_description = definition.name, definition.description
        self.region = definition.region(region).name
        self.perception = str(PerceptionSettings.read(perception))
        self.single_observation_space = observation_space(definition, obs_type, image_size)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes = RunningEpisodes(
            definition, num_envs, num_threads, obs_type, controller, perception, image_size, variation
        )
        self._max_episode_steps = self._episodes.max_steps
        self._mode = autoreset_mode
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._ended = np.ones(num_envs, dtype=bool)  # none has begun

    @property
    def sim(self) -> Simulation:
        """The simulation of all worlds."""
        return self._episodes.sim

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin new episodes.

        Args:
            seed: One number s for s, s + 1, ..., or one a world; None keeps a world's random numbers going.
            options: "region"; "initial_state", one for all worlds, a list with one each, or those of ``infos``;
                "reset_mask", (N,) bool, which worlds, all by default.

        Raises:
            SceneError: As many seeds or initial states as worlds were expected, or the mask is no (N,) bool.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        mask = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise SceneError(f"reset_mask={mask.tolist()}", f"{self.num_envs} of True and False", "give one each")
        worlds = np.flatnonzero(mask)
        if isinstance(seed, Sequence | np.ndarray):
            seeds = [None if each is None else int(each) for each in seed]
        else:
            seeds = [None if seed is None else seed + world for world in range(self.num_envs)]
        given = options.pop("initial_state", None)
        if isinstance(given, dict) and "_robot" in given:
            given = _unstacked(given)
        states: Sequence[Any] = given if isinstance(given, list | tuple) else [given] * self.num_envs
        for what, values in (("seeds", seeds), ("initial states", states)):
            if len(values) != self.num_envs:
                raise SceneError(f"{len(values)} {what}", f"{self.num_envs}, one a world", "give one each")
        for world in worlds:
            if seeds[world] is not None or self._randoms[world] is None:
                self._randoms[world] = seeding.np_random(seeds[world])[0]
        infos = self._begin(worlds, options, states)
        return self._episodes.observe(), infos

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply one command a world for 0.1 s.

        Raises:
            CommandError: Not (N, 23) numbers, finite in every world whose episode is going on.
        """
        transition = self._episodes.step(actions, ~self._ended)
        terminated, truncated = transition.terminated, transition.truncated
        observation = self._episodes.observe()
        going = np.ones(self.num_envs, dtype=bool)
        infos: dict[str, Any] = {}
        self._ended |= terminated | truncated
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            worlds = np.flatnonzero(self._ended)
            going = ~self._ended
            for world in worlds:
                final = {name: values[world].item() for name, values in transition.info.items()}
                last = {"final_obs": first_row(observation, world), "final_info": final}
                infos = self._add_info(infos, last, world)
            infos = self._begin(worlds, {}, [None] * self.num_envs, infos)
            observation = self._episodes.observe()
        for name, values in transition.info.items():
            fresh = infos.get(name, np.zeros_like(values))
            infos[name] = np.where(going, values, fresh)
            infos[f"_{name}"] = np.ones(self.num_envs, dtype=bool)
        return observation, transition.reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...]:
        """Return an image (480, 640, 3) uint8 of the overview camera for each world."""
        return tuple(self._episodes.render(world) for world in range(self.num_envs))

    def perception_faults(self, world: int = 0) -> dict[str, int]:
        """Return how often what went wrong with the eyes in a world's episode, by its reason."""
        return self._episodes.perception_faults(world)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:  # noqa: ANN401
        """Return an attribute, or what a method returns, once a world, as ``SyncVectorEnv`` does."""
        value = getattr(self, name)
        if name == "render":
            return self.render()
        if name == "perception_faults":
            return tuple(self.perception_faults(world) for world in range(self.num_envs))
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute, once a world."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ANN401
        """Close graphics context and threads."""
        self._episodes.close()

    def _begin(
        self,
        worlds: np.ndarray,
        options: dict[str, Any],
        given: Sequence[InitialState | None],
        infos: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Begin episodes in some worlds and add what is known of them to the infos."""
        states = []
        for world in worlds:
            generator = self._randoms[world]
            if generator is None:
                raise SceneError("a step", "a reset before it", "call reset first")
            world_options = {**options, "initial_state": given[world]}
            states.append(initial_state(self._episodes.task, self.region, generator, world_options))
        states = self._episodes.reset(states, worlds)
        self._ended[worlds] = False
        facts = self._episodes.info()
        collected: dict[str, Any] = infos or {}
        for world, state in zip(worlds, states, strict=True):
            info = {name: values[world].item() for name, values in facts.items()}
            collected = self._add_info(collected, {**info, "initial_state": state}, world)
        return collected


def _unstacked(infos: dict[str, Any]) -> list[InitialState]:
    """Return the initial states, one a world, of a vector environment's infos; empty ones of worlds without any.

    Raises:
        SceneError: The arrays are of several lengths, or one has no mask.
    """
    keys = [key for key in infos if not key.startswith("_")]
    if len({len(rows) for rows in infos.values()}) > 1 or any(f"_{key}" not in infos for key in keys):
        got = f"an initial_state with arrays {sorted(infos)}"
        raise SceneError(got, "one row a world, and a mask beside each array", "give it as infos has it")
    return [
        {key: infos[key][world] for key in keys if infos[f"_{key}"][world]} for world in range(len(infos["_robot"]))
    ]
