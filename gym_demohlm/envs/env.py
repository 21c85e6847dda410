"""One world as a Gymnasium environment: ``gym.make("DemoHLM/LiftBox-v0")``.

The same code as ``DemoHLMVectorEnv`` with one world, and the same bits.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs.episode import EXACT, RunningEpisodes, action_space, initial_state, observation_space
from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Window
from gym_demohlm.errors import CommandError, UnknownNameError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Controller, Simulation
from gym_demohlm.task import DEFAULT_REGION
from gym_demohlm.timing import STEP_DT

RENDER_MODES = ("human", "rgb_array")


class DemoHLMEnv(gym.Env):
    """A G1 and one task; 10 steps a second.

    Args:
        task: Name of the task.
        obs_type: "state", or "pixels_agent_pos" to add the head camera's image.
        render_mode: None, "rgb_array" (the overview camera) or "human" (a window).
        region: Initial region from which ``reset`` draws.
        controller: For one world, or its name, path or hash (`demohlm controllers`); the default one by default.
        perception: How observation and gaze see objects: "exact", "rgbd", "rgbd,masks=color" ... (docs/perception.md).
        image_size: Width and height of the head camera's images [px]. Smaller ones are drawn as datasets' pictures are.
        variation: How the world differs from episode to episode: "none", "real" or "hard" (docs/variation.md).

    Attributes:
        task: Name of the task.
        task_description: The instruction in words.

    Raises:
        UnknownNameError: No such task, region, obs_type, render_mode, perception or variation.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / STEP_DT)}

    def __init__(
        self,
        task: str = "LiftBox",
        obs_type: str = "state",
        render_mode: str | None = None,
        region: str = DEFAULT_REGION,
        controller: Controller | str | None = None,
        perception: str | PerceptionSettings = EXACT,
        image_size: tuple[int, int] = (WIDTH, HEIGHT),
        variation: str = "none",
    ) -> None:
        check_render_mode(render_mode)
        definition = get_task(task).at(region)
        self.task, self.task_description = definition.name, definition.description
        self.region = definition.region(region).name
        self.render_mode = render_mode
        self.observation_space = observation_space(definition, obs_type, image_size)
        self.action_space = action_space()
        self._episodes = RunningEpisodes(
            definition,
            obs_type=obs_type,
            controller=controller,
            perception=perception,
            image_size=image_size,
            variation=variation,
        )
        self._max_episode_steps = self._episodes.max_steps
        self._window: Window | None = None

    @property
    def sim(self) -> Simulation:
        """The simulation of the one world."""
        return self._episodes.sim

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Of ``np_random``, from which the initial state is drawn.
            options: "region": another region for this episode; "initial_state": the very state to start from.

        Returns:
            Observation, and info with the initial state and the conditions in it.
        """
        super().reset(seed=seed)
        state = initial_state(self._episodes.task, self.region, self.np_random, options)
        (state,) = self._episodes.reset([state])
        self._show()
        return self._observe(), {**self._info(), "initial_state": state}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply one command for 0.1 s.

        Raises:
            CommandError: The action is not 23 finite numbers.
        """
        if np.shape(action) != (command.SIZE,):
            raise CommandError(f"an action of shape {np.shape(action)}", f"({command.SIZE},)", "see command.NAMES")
        transition = self._episodes.step(np.asarray(action)[None])
        self._show()
        return (
            self._observe(),
            float(transition.reward[0]),
            bool(transition.terminated[0]),
            bool(transition.truncated[0]),
            self._info(),
        )

    def perception_faults(self) -> dict[str, int]:
        """Return how often what went wrong with the eyes in this episode, by its reason."""
        return self._episodes.perception_faults()

    def render(self) -> np.ndarray | None:
        """Return an image (480, 640, 3) uint8 of the overview camera, or None where a window shows it."""
        if self.render_mode == "human":
            self._show()
            return None
        return self._episodes.render()

    def close(self) -> None:
        """Close window, graphics context and threads."""
        if self._window is not None:
            self._window.close()
            self._window = None
        self._episodes.close()

    def _observe(self) -> dict[str, Any]:
        return first_row(self._episodes.observe())

    def _info(self) -> dict[str, Any]:
        return {name: values[0].item() for name, values in self._episodes.info().items()}

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window = self._window or Window(self._episodes.sim.model)
            self._window.show(self._episodes.sim.mj_data())


def check_render_mode(render_mode: str | None, allowed: Sequence[str] = RENDER_MODES) -> None:
    """Raise UnknownNameError for a render mode that an environment does not have."""
    if render_mode is not None and render_mode not in allowed:
        raise UnknownNameError("render_mode", render_mode, allowed)


def first_row(batch: dict[str, Any], row: int = 0) -> dict[str, Any]:
    """Return copies of one row of a dictionary of arrays, nested ones too."""
    return {
        key: first_row(value, row) if isinstance(value, dict) else value[row].copy() for key, value in batch.items()
    }
