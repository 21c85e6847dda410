"""Task, demonstration, region, seed, index -> one episode: a pure function, whatever else runs beside it.

Attempts run side by side as worlds of one simulation, in lockstep; a world has the same bits alone and in a batch.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import observation
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.simulation import STEP_DT, Simulation
from gym_demohlm.task import InitialState, Task
from lerobot_demohlm.dataset import OUTCOMES, Episode
from lerobot_demohlm.demonstration import Demonstration
from lerobot_demohlm.generation import stages
from lerobot_demohlm.generation.playback import Playback
from lerobot_demohlm.generation.stages import Settings, StageError
from lerobot_demohlm.generation.world import World
from lerobot_demohlm.segmentation import Segment, segment

HELD_TICKS = 10  # success counts once it has held for 1 s, up to the end
COLLISION_N = 60.0  # force between robot and obstacle that counts as a collision
COLLISION_TICKS = 3  # once it has lasted this long (0.3 s)
GENERATION_STREAM = 0  # first number of a seed sequence; evaluation and training use others, so seeds never overlap


def initial_state(task: Task, region: str, seed: int, index: int) -> InitialState:
    """Draw where attempt ``index`` of run ``seed`` starts."""
    return task.sample(region, np.random.default_rng([GENERATION_STREAM, seed, index]))


@dataclass
class _Running:
    """An attempt under way."""

    index: int
    start: InitialState
    world: World
    commands: Iterator[np.ndarray] = field(default_factory=lambda: iter(()))
    stage: str = stages.LOCOMOTION
    outcome: str | None = None
    collision_ticks: int = 0
    state: list[np.ndarray] = field(default_factory=list)
    environment_state: list[np.ndarray] = field(default_factory=list)
    action: list[np.ndarray] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)


class Attempts:
    """Runs attempts of one task and demonstration; keeps the simulation and the solver for the next call.

    Args:
        task: The task.
        demonstration: Of that task.
        region: Initial region.
        seed: Of the run.
        num_worlds: Most attempts at once.
        settings: Gains, limits and times.
        on_step: Called with the simulation at the start of attempts and after every step, for pictures.
    """

    def __init__(
        self,
        task: Task,
        demonstration: Demonstration,
        region: str,
        seed: int,
        num_worlds: int = 1,
        settings: Settings | None = None,
        on_step: Callable[[Simulation], None] | None = None,
    ) -> None:
        self._on_step = on_step or (lambda _: None)
        self.task, self.demonstration, self.region, self.seed = task, demonstration, region, seed
        self.settings = settings or Settings()
        self._segments: list[Segment] = segment(demonstration)
        self._sim = Simulation(task, num_worlds=num_worlds)
        self._ik = WholeBodyIK(self._sim.model)
        self._num_ticks = round(task.episode_length_s / STEP_DT)

    def close(self) -> None:
        """Release the simulation."""
        self._sim.close()

    def run(self, indices: Sequence[int]) -> list[Episode]:
        """Make attempts and return their episodes in order."""
        episodes: list[Episode] = []
        num_worlds = self._sim.num_worlds
        for first in range(0, len(indices), num_worlds):
            episodes += self._run_together(indices[first : first + num_worlds])
        return episodes

    def _run_together(self, indices: Sequence[int]) -> list[Episode]:
        sim = self._sim
        starts = [initial_state(self.task, self.region, self.seed, index) for index in indices]
        sim.reset(starts, np.arange(len(indices)))
        self._on_step(sim)
        running = [
            _Running(index=index, start=start, world=World(sim=sim, index=world, ik=self._ik))
            for world, (index, start) in enumerate(zip(indices, starts, strict=True))
        ]
        for attempt in running:
            attempt.commands = self._commands(attempt)
        while any(attempt.outcome is None for attempt in running):
            self._step(running)
        return [self._episode(attempt) for attempt in running]

    def _step(self, running: list[_Running]) -> None:
        """Ask every attempt for a command, make one step of all worlds, and judge them."""
        sim = self._sim
        commands, active = sim.command, np.zeros(sim.num_worlds, dtype=bool)
        for attempt in running:
            wanted = self._next_command(attempt)
            if wanted is not None:
                # What a dataset stores is what was applied: float32.
                commands[attempt.world.index] = wanted.astype(np.float32)
                active[attempt.world.index] = True
        if not active.any():
            return
        state, environment_state = observation.agent_pos(sim), observation.environment_state(sim)
        result = sim.step(commands, active)
        self._on_step(sim)
        success, fallen, failures = sim.success(), sim.fallen(), sim.failures()
        for attempt in running:
            world = attempt.world.index
            if not active[world]:
                continue
            attempt.state.append(state[world])
            attempt.environment_state.append(environment_state[world])
            attempt.action.append(commands[world].astype(np.float32))
            attempt.success.append(bool(success[world]))
            struck = result.collision_forces[world].max() > COLLISION_N
            attempt.collision_ticks = attempt.collision_ticks + 1 if struck else 0
            if fallen[world] or result.unstable[world]:
                attempt.outcome = "fell"
            elif attempt.collision_ticks >= COLLISION_TICKS:
                attempt.outcome = "collided"
            else:
                failed = [name for name, happened in failures.items() if happened[world]]
                if failed:
                    attempt.outcome = _failure_outcome(attempt, failed[0])
            if attempt.outcome is None and len(attempt.action) >= self._num_ticks:
                attempt.outcome = self._final_outcome(attempt)

    def _next_command(self, attempt: _Running) -> np.ndarray | None:
        if attempt.outcome is not None:
            return None
        try:
            return next(attempt.commands)
        except StopIteration:
            attempt.outcome = self._final_outcome(attempt)
        except StageError as failure:
            attempt.outcome = failure.outcome
        return None

    def _commands(self, attempt: _Running) -> Iterator[np.ndarray]:
        """Go through the stages of one attempt."""
        world, demonstration = attempt.world, self.demonstration
        placement = stages.choose_placement(world, self.task, demonstration, self._segments)
        yield from stages.locomotion(world, placement.goal, self.settings.locomotion)
        playback = Playback(world, self.task, demonstration, self._segments, placement.symmetry, self.settings)
        for wanted in playback.run():
            attempt.stage = playback.stage
            yield wanted

    def _final_outcome(self, attempt: _Running) -> str:
        """Judge an attempt whose motion or time is over."""
        held = attempt.success[-HELD_TICKS:]
        return "success" if len(held) == HELD_TICKS and all(held) else "timeout"

    def _episode(self, attempt: _Running) -> Episode:
        assert attempt.outcome is not None  # run together ends when all have one
        length = len(attempt.action)
        width = len(observation.environment_names(self.task))

        def rows(values: list[np.ndarray], columns: int) -> np.ndarray:
            return np.stack(values) if values else np.zeros((0, columns), dtype=np.float32)

        return Episode(
            task=self.task.name,
            task_text=self.task.description,
            index=attempt.index,
            seed=self.seed,
            region=self.region,
            outcome=attempt.outcome,
            stage=attempt.stage,
            state=rows(attempt.state, len(observation.STATE_NAMES)),
            environment_state=rows(attempt.environment_state, width),
            action=rows(attempt.action, 23),
            success=np.array(attempt.success, dtype=bool),
            initial_state=copy.deepcopy(attempt.start),
            length_s=length * STEP_DT,
        )


def _failure_outcome(attempt: _Running, name: str) -> str:
    """Return the outcome that a task's failure predicate stands for; before the hands take hold, it was run into."""
    if attempt.stage != stages.MANIPULATION:
        return "collided"
    return name if name in OUTCOMES else "dropped"


def attempt(task: Task, demonstration: Demonstration, region: str, seed: int, index: int) -> Episode:
    """Make one attempt: a function of its arguments and the installation."""
    attempts = Attempts(task, demonstration, region, seed)
    try:
        return attempts.run([index])[0]
    finally:
        attempts.close()
