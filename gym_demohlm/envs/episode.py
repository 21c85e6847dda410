"""Actions of N worlds -> what both environments report of their episodes: observation, reward, success, failure, time.

Success is reported four ways: ``success_ever`` (the paper's condition held at some step), ``success`` (it holds now),
``success_held`` (it held for 1 s without a break), and ``success_strict`` (the same without a drop or a collision at
any time, and the robot stands for 2 s after it). ``is_success``, which LeRobot scores, is the strict one. An episode
ends when the success was held, the robot fell or the physics broke down; the time limit truncates it. Successes, falls
and collisions are judged as in generation (``simulation.judge``).
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.perception.disturbance import varies
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation import Controller, Simulation
from gym_demohlm.simulation.judge import Judge
from gym_demohlm.task import WIDEST, InitialState, Task
from gym_demohlm.timing import STEP_DT
from gym_demohlm.variation import get_variation

if TYPE_CHECKING:
    from gym_demohlm.perception.sight import Sight
    from gym_demohlm.perception.small_pictures import SmallPictures

EXACT = "exact"
OBSERVATION_TYPES = ("state", "pixels_agent_pos")
_OPTIONS = ("initial_state", "region", "reset_mask")  # of reset
Observation = dict[str, np.ndarray | dict[str, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class Transition:
    """One step of all worlds; rows of worlds that were left out repeat their last values.

    Attributes:
        reward: (N,) 1 where the success condition holds, else 0.
        terminated: (N,) bool.
        truncated: (N,) bool.
        info: Arrays (N,) by name, see ``RunningEpisodes.info``.
    """

    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict[str, np.ndarray]


class RunningEpisodes:
    """N worlds with their episode counters; knows nothing of seeds or autoreset.

    Args:
        task: The task.
        num_worlds: N.
        num_threads: Threads of the physics.
        obs_type: "state", or "pixels_agent_pos" to add the head camera's image.
        controller: For these worlds, or its name, path or hash; the default one by default.
        perception: How objects are seen, such as "exact", or "rgbd" for a tracker of a simulated depth camera's
            images; see ``gym_demohlm.perception.settings``. In worlds whose variation has the group ``perception``,
            "exact" has the errors that episodes draw.
        image_size: Width and height of the head camera's images [px]. Smaller ones are drawn as datasets' pictures are.
        variation: How worlds differ: "none", "real" or "hard" (docs/variation.md).

    Raises:
        UnknownNameError: No such obs_type, perception or variation.
    """

    def __init__(
        self,
        task: Task,
        num_worlds: int = 1,
        num_threads: int = 1,
        obs_type: str = "state",
        controller: Controller | str | None = None,
        perception: str | PerceptionSettings = EXACT,
        image_size: tuple[int, int] = (WIDTH, HEIGHT),
        variation: str = "none",
    ) -> None:
        if obs_type not in OBSERVATION_TYPES:
            raise UnknownNameError("obs_type", obs_type, OBSERVATION_TYPES)
        self.task = task
        self.obs_type = obs_type
        self.max_steps = max_episode_steps(task)
        self.sim = Simulation(task, num_worlds, num_threads, controller, variation=get_variation(variation))
        self._renderer = Renderer(self.sim.model)
        self._steps = np.zeros(num_worlds, dtype=np.int64)
        self._judge = Judge(self.sim)
        self._clipped = np.zeros(num_worlds, dtype=np.int64)
        self._image_size = image_size
        self._small: SmallPictures | None = None
        self._strict = np.zeros(num_worlds, dtype=bool)
        self._sight: Sight | None = None
        settings = PerceptionSettings.read(perception)
        if not settings.is_exact or varies(self.sim.variation):
            from gym_demohlm.perception import sight  # loads OpenCV and SciPy

            self._sight = sight.Sight(self.sim, settings)

    def reset(self, initial_states: Sequence[InitialState], worlds: np.ndarray | None = None) -> Sequence[InitialState]:
        """Begin new episodes in some worlds, all by default; one initial state each.

        Returns:
            The initial states with the conditions of their worlds.
        """
        initial_states = [self.sim.vary(state) for state in initial_states]
        rows = np.arange(self.sim.num_worlds) if worlds is None else np.asarray(worlds)
        self.sim.reset(initial_states, rows)
        self._judge.reset(rows)
        self._steps[rows] = self._clipped[rows] = 0
        self._strict[rows] = False
        if self._sight is not None:
            self._sight.begin(rows, initial_states)
        return initial_states

    def step(self, actions: np.ndarray, active: np.ndarray | None = None) -> Transition:
        """Apply one action a world for 0.1 s.

        Args:
            actions: (N, 23), see command.NAMES.
            active: (N,) which worlds to step, all by default; the others and their counters stay as they are.

        Raises:
            CommandError: A wrong shape, or numbers that are not finite in an active row.
        """
        moved = np.ones(self.sim.num_worlds, dtype=bool) if active is None else np.asarray(active, dtype=bool)
        result = self.sim.step(actions, moved)
        self._steps += moved
        self._clipped[moved] = result.num_clipped[moved]
        self._judge.watch(result, moved)
        if self._sight is not None:
            self._sight.look(np.flatnonzero(moved & ~result.unstable))
        ended = np.flatnonzero(moved & self._judge.success_held)
        if len(ended):
            self._strict[ended] = self._judge.strict(ended)
        info = self.info()
        terminated = info["success_held"] | info["fell"] | info["unstable"]
        truncated = ~terminated & (self._steps >= self.max_steps)
        return Transition(
            reward=self._judge.success.astype(np.float64), terminated=terminated, truncated=truncated, info=info
        )

    def info(self) -> dict[str, np.ndarray]:
        """Return what is known of each world's episode, (N,) each.

        Keys: is_success, success, success_ever, success_held, success_strict, fell, unstable, collided (has pressed on
        an obstacle in three steps in a row, at some time in each with more than 60 N), each of the task's failures
        (bool), and clipped, how many numbers of the last action were out of bounds.
        """
        judge = self._judge
        info = {
            "is_success": self._strict.copy(),
            "success": judge.success.copy(),
            "success_ever": judge.success_ever.copy(),
            "success_held": judge.success_held,
            "success_strict": self._strict.copy(),
            "fell": judge.fell.copy(),
            "unstable": judge.unstable.copy(),
            "collided": judge.collided.copy(),
            "clipped": self._clipped.copy(),
        }
        for name, holds in judge.failures.items():
            info[name] = holds | info[name] if name in info else holds.copy()
        return info

    def perception_faults(self, world: int = 0) -> dict[str, int]:
        """Return how often what went wrong with the eyes in a world's episode, by its reason."""
        return {} if self._sight is None else self._sight.faults(world)

    def observe(self) -> Observation:
        """Return the observations of all worlds, new arrays with one row a world."""
        seen: Observation = {
            "agent_pos": observation.agent_pos(self.sim),
            "environment_state": (
                observation.environment_state(self.sim) if self._sight is None else self._sight.environment_state()
            ),
        }
        if self.obs_type == "pixels_agent_pos":
            images = [self._head_image(world) for world in range(self.sim.num_worlds)]
            seen["pixels"] = {"head": np.stack(images)}
        return seen

    def render(self, world: int = 0, camera: str = "overview") -> np.ndarray:
        """Return an image (480, 640, 3) uint8 of a world."""
        return self._renderer.render(self.sim.mj_data(world), camera)

    def _head_image(self, world: int) -> np.ndarray:
        """Return what a world's head camera sees (height, width, 3) uint8."""
        if self._image_size == (WIDTH, HEIGHT):
            return self.render(world, "head")
        if self._small is None:
            from gym_demohlm.perception.small_pictures import SmallPictures  # loads a graphics library

            self._small = SmallPictures(self.sim, self._image_size)
        return self._small.rgb(world)

    def close(self) -> None:
        """Stop the threads and give the graphics context back."""
        self._renderer.close()
        if self._sight is not None:
            self._sight.close()
        if self._small is not None:
            self._small.close()
        self.sim.close()


def max_episode_steps(task: Task) -> int:
    """Return the time limit of a task in steps of 0.1 s."""
    return max(1, round(task.episode_length_s / STEP_DT))


def observation_space(task: Task, obs_type: str, image_size: tuple[int, int] = (WIDTH, HEIGHT)) -> gym.spaces.Dict:
    """Return the observation space of one world."""
    spaces: dict[str, gym.Space] = {
        "agent_pos": _unbounded(len(observation.STATE_NAMES)),
        "environment_state": _unbounded(observation.OBJECT_SIZE * len(task.objects)),
    }
    if obs_type == "pixels_agent_pos":
        image = gym.spaces.Box(0, 255, (image_size[1], image_size[0], 3), np.uint8)
        spaces["pixels"] = gym.spaces.Dict({"head": image})
    return gym.spaces.Dict(spaces)


def action_space() -> gym.spaces.Box:
    """Return the action space of one world: a command inside its bounds."""
    return gym.spaces.Box(command.LOWER.astype(np.float32), command.UPPER.astype(np.float32), dtype=np.float32)


def initial_state(task: Task, region: str, rng: np.random.Generator, options: dict | None) -> InitialState:
    """Return where an episode starts: ``options["initial_state"]``, or drawn from ``options["region"]`` or region.

    Raises:
        UnknownNameError: The task has no such region, or an option is misspelt.
        SceneError: The initial state in the options is not a dictionary, or R4 has other things than these worlds.
    """
    options = options or {}
    for name in options.keys() - _OPTIONS:  # LeRobot and wrappers have options of their own
        if difflib.get_close_matches(name, _OPTIONS, n=1, cutoff=0.6):
            raise UnknownNameError("option of reset", name, _OPTIONS)
    given, asked = options.get("initial_state"), options.get("region", region)
    if given is None:
        if asked == WIDEST and task.wide_form is not None:
            raise SceneError(
                f"region {WIDEST} in worlds of {region}", "worlds of its own", f'make them with "{WIDEST}"'
            )
        return task.sample(asked, rng)
    if not isinstance(given, dict):
        raise SceneError(f"initial_state={given!r}", "a dictionary", "see gym_demohlm.task.InitialState")
    try:
        return {key: [float(value) for value in values] for key, values in given.items()}
    except (TypeError, ValueError):
        raise SceneError(
            f"initial_state={given!r}", "a list of numbers for each key", "see gym_demohlm.task.InitialState"
        ) from None


def _unbounded(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
