"""Task, demonstration, region, seed, index -> one episode: a pure function, whatever else runs beside it.

Attempts run side by side as worlds of one simulation, in lockstep; a world has the same bits alone and in a batch.
"""

import copy
import math
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.envs import observation
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.judge import COLLISION_N, COLLISION_S, FALLEN_HEIGHT, FALLEN_TILT, Judge, fault_outcome
from gym_demohlm.task import SCORING_SEEDS, WIDEST, InitialState, Task
from gym_demohlm.timing import STEP_DT
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation import command_noise, stages
from lerobot_demohlm.generation.eyes import open_sight, seen_objects
from lerobot_demohlm.generation.fitting import fitted
from lerobot_demohlm.generation.handing_over import HandingOver, handed_over
from lerobot_demohlm.generation.playback import Playback
from lerobot_demohlm.generation.retarget import Placement
from lerobot_demohlm.generation.stages import Settings, StageError
from lerobot_demohlm.generation.steadying import steadied
from lerobot_demohlm.generation.tables import Table, stand_off, tables_under
from lerobot_demohlm.generation.world_view import WorldView
from lerobot_demohlm.reproducibility.fingerprint import Trail

GENERATION_STREAM = 0  # first number of a seed sequence; evaluation and training use others, so seeds never overlap


def initial_state(task: Task, region: str, seed: int, index: int, spread: float = 1.0) -> InitialState:
    """Draw where attempt ``index`` of run ``seed`` starts, in a region whose robot poses are widened by a factor.

    In R1 to R3 attempts of the same seed and index start alike in all tasks, as data sets on disk do. In R4, and with a
    seed that is kept for scoring, starts are independent for each task and region.
    """
    words = [GENERATION_STREAM, seed, index]
    if region == WIDEST or seed in SCORING_SEEDS:
        words.append(zlib.crc32(f"{task.name} {region}".encode()))
    return task.sample(region, np.random.default_rng(words), spread)


@dataclass
class Attempt:
    """An attempt under way; its lists have one entry for every step made.

    Attributes:
        index: Index of the attempt in its run.
        start: Initial state of its world.
        world: The world that it runs in.
        commands: The commands that are still to come.
        noise: The noise that is still to come; None where commands are executed as planned.
        placement: Where the robot is to stand; None until that is chosen.
        playback: What moves the hands; None until the robot stands at its place.
        stage: Current stage.
        outcome: One of ``OUTCOMES``; None until the attempt ends.
        reason: Why the attempt ended, in words; empty for a success.
        retries: Number of times that it began again after a stage that failed.
        strict: Whether it is a strict success.
        trail: Fingerprints of its world.
        state: (68,) observation of the robot before each step.
        environment_state: (9k,) observation of the objects before each step.
        action: (23,) command of each step as planned.
        executed: (23,) command of each step as applied.
        success: Whether the task's condition held after each step.
        stages: Stage of each step.
        contact_forces: (5, pairs) normal forces of each step between hands and objects [N].
        collision_forces: (5,) largest normal force of each step between robot and obstacles [N].
    """

    index: int
    start: InitialState
    world: WorldView
    commands: Iterator[np.ndarray] = field(default_factory=lambda: iter(()))
    noise: Iterator[np.ndarray] | None = None
    placement: Placement | None = None
    playback: Playback | None = None
    stage: str = stages.LOCOMOTION
    outcome: str | None = None
    reason: str = ""
    retries: int = 0
    strict: bool = False
    trail: Trail = field(default_factory=Trail)
    state: list[np.ndarray] = field(default_factory=list)
    environment_state: list[np.ndarray] = field(default_factory=list)
    action: list[np.ndarray] = field(default_factory=list)
    executed: list[np.ndarray] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)
    stages: list[str] = field(default_factory=list)
    contact_forces: list[np.ndarray] = field(default_factory=list)
    collision_forces: list[np.ndarray] = field(default_factory=list)

    def end(self, outcome: str, reason: str = "") -> None:
        """Note how the attempt ended."""
        self.outcome, self.reason = outcome, reason


class Attempts:
    """Makes attempts at one task from one demonstration; keeps the simulation and the solver for the next call.

    Args:
        task: The task.
        demonstration: A demonstration of the task.
        region: Initial region.
        seed: Seed of the run.
        num_worlds: Largest number of attempts that run side by side.
        settings: Variation, gains, limits and times; those of ``demohlm generate`` by default.
        on_step: Called with the simulation at the start of attempts and after every step, for pictures.
        on_command: Called with an attempt and the command (23,) that it has chosen, before the step, for explanations.
        sim: The simulation that attempts run in, which ``close`` closes; a new one with ``num_worlds`` by default.
        controller: Name, path or hash of the whole-body controller of a new one; the default one by default.

    Attributes:
        ik: Solver of the inverse kinematics, shared by all attempts; it keeps no state.
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
        on_command: Callable[[Attempt, np.ndarray], None] | None = None,
        sim: Simulation | None = None,
        controller: str | None = None,
    ) -> None:
        self._on_step = on_step or (lambda _: None)
        self._on_command = on_command or (lambda _attempt, _command: None)
        self.task, self.region, self.seed = task.at(region), region, seed
        self.demonstration, self.settings = fitted(demonstration, self.task), settings or Settings()
        self._segments: list[Segment] = segment(self.demonstration, self.task, task.is_scattered(region))
        self.demonstration = steadied(self.demonstration, self.task, self._segments)
        variation = get_variation(self.settings.variation.variation)
        self._sim = sim or Simulation(self.task, num_worlds, controller=controller, variation=variation)
        self._judge = Judge(self._sim)
        self._sight = open_sight(self._sim, self.settings.variation.perception)
        self.ik = WholeBodyIK(self._sim.model, self.settings.ik)
        self._num_ticks = round(task.episode_length_s / STEP_DT)

    def close(self) -> None:
        """Release the simulation and the eyes."""
        self.close_eyes()
        self._sim.close()

    def close_eyes(self) -> None:
        """Release the eyes alone: the simulation is somebody else's, and its necks see exactly again."""
        if self._sight is not None:
            self._sight.close()

    def run(self, indices: Sequence[int]) -> list[Episode]:
        """Make attempts and return their episodes in order."""
        episodes: list[Episode] = []
        num_worlds = self._sim.num_worlds
        for first in range(0, len(indices), num_worlds):
            episodes += self._run_together(indices[first : first + num_worlds])
        return episodes

    def _run_together(self, indices: Sequence[int]) -> list[Episode]:
        sim = self._sim
        variation = self.settings.variation
        noisy, spread = variation.command_noise > 0.0, variation.start_spread
        starts = [initial_state(self.task, self.region, self.seed, index, spread) for index in indices]
        starts = [sim.vary(start) for start in starts]
        sim.reset(starts, np.arange(len(indices)))
        self._judge.reset(np.arange(len(indices)))
        if self._sight is not None:
            self._sight.begin(np.arange(len(indices)), starts)
        self._on_step(sim)
        running = [
            Attempt(index=index, start=start, world=WorldView(sim=sim, index=world, ik=self.ik))
            for world, (index, start) in enumerate(zip(indices, starts, strict=True))
        ]
        before = sim.snapshot()
        for attempt in running:
            attempt.commands = self._commands(attempt)
            attempt.noise = command_noise.bursts(self.seed, attempt.index) if noisy else None
            attempt.trail.add(before, attempt.world.index)
        while any(attempt.outcome is None for attempt in running):
            self._step(running)
        self._judge_strictly(running)
        return [self._episode(attempt) for attempt in running]

    def _judge_strictly(self, running: Sequence[Attempt]) -> None:
        """Let the robots of attempts that have succeeded stand, and note who does."""
        successes = [attempt for attempt in running if attempt.outcome == "success"]
        found = self._judge.strict(np.array([attempt.world.index for attempt in successes], dtype=np.int64))
        for attempt, strict in zip(successes, found, strict=True):
            attempt.strict = bool(strict)

    def _step(self, running: list[Attempt]) -> None:
        """Ask every attempt for a command, make one step of all worlds, and judge them."""
        sim = self._sim
        commands, active = sim.command, np.zeros(sim.num_worlds, dtype=bool)
        planned = commands.astype(np.float32)  # as a dataset stores them
        for attempt in running:
            wanted, world = self._next_command(attempt), attempt.world.index
            if wanted is not None:
                planned[world] = wanted
                commands[world] = planned[world] if attempt.noise is None else self._disturbed(attempt, planned[world])
                active[world] = True
        if not active.any():
            return
        state, environment_state = observation.agent_pos(sim), seen_objects(sim, self._sight)
        result = sim.step(commands, active)
        if self._sight is not None:
            self._sight.look(np.flatnonzero(active))
        self._on_step(sim)
        self._judge.watch(result, active)
        faults, after = self._judge.faults(), sim.snapshot()
        for attempt in running:
            world = attempt.world.index
            if not active[world]:
                continue
            attempt.state.append(state[world])
            attempt.environment_state.append(environment_state[world])
            attempt.action.append(planned[world].copy())
            attempt.executed.append(commands[world].astype(np.float32))
            attempt.world.noise[:] = commands[world] - planned[world]
            attempt.success.append(bool(self._judge.condition[world]))
            attempt.stages.append(attempt.stage)
            attempt.contact_forces.append(result.contact_forces[world])
            attempt.collision_forces.append(result.collision_forces[world])
            attempt.trail.add(after, world, attempt.action[-1])
            fault = next((name for name, happened in faults.items() if happened[world]), None)
            if fault == "fell":
                attempt.end("fell", _fall(attempt.world, bool(result.unstable[world])))
            elif fault == "collided":
                force = result.collision_forces[world].max()
                attempt.end(
                    "collided",
                    f"the robot pressed on an obstacle with {force:.0f} N, and with more than {COLLISION_N:g} N for "
                    f"{COLLISION_S:.1f} s",
                )
            elif fault is not None:
                attempt.end(*_failure(attempt, fault))
            elif self.settings.adapts and self._judge.success_held[world]:
                attempt.end("success")  # where a rollout ends, too
            elif len(attempt.action) >= self._num_ticks * (1 + attempt.retries):
                limit_s = self.task.episode_length_s * (1 + attempt.retries)
                self._conclude(attempt, f"the time limit of {limit_s:g} s was reached")

    def _next_command(self, attempt: Attempt) -> np.ndarray | None:
        if attempt.outcome is not None:
            return None
        try:
            wanted = next(attempt.commands)
        except StopIteration:
            self._conclude(attempt, "the motion was over")
        except StageError as failure:
            attempt.end(failure.outcome, failure.reason)
        else:
            self._on_command(attempt, wanted)
            return wanted
        return None

    def _disturbed(self, attempt: Attempt, planned: np.ndarray) -> np.ndarray:
        """Return the command (23,) float32 that is executed where an attempt has planned one."""
        assert attempt.noise is not None  # else there is nothing to ask for
        noise, delicate = next(attempt.noise), attempt.playback is not None and attempt.playback.delicate
        share = 0.0 if delicate else self.settings.variation.command_noise * command_noise.SHARES[attempt.stage]
        return command_noise.disturbed(planned, share * noise)

    def _commands(self, attempt: Attempt) -> Iterator[np.ndarray]:
        """Go through the stages of one attempt, as often as it may."""
        while True:
            try:
                yield from self._try(attempt)
                return
            except StageError as failure:
                if not failure.again or attempt.retries == self.settings.retries:
                    raise
            attempt.retries += 1
            if attempt.playback is not None:
                yield from attempt.playback.withdraw(self.settings.retreat)
            attempt.playback, attempt.stage = None, stages.LOCOMOTION
            yield from stages.step_back(attempt.world, self.settings.retreat)

    def _try(self, attempt: Attempt) -> Iterator[np.ndarray]:
        """Go through the stages once, from where things are."""
        world, demonstration = attempt.world, self.demonstration
        chosen = stages.choose_placement(world, self.task, demonstration, self._segments)
        goal = chosen.goal
        if self.task.supports and self.task.is_scattered(self.region):
            goal = stages.clear_stance(goal, world, self.task, demonstration, self._segments)
        tables = self._tables(world)
        if tables is not None:
            goal = stand_off(goal, poses.to_planar(demonstration.T_world_pelvis[0]), tables, self.settings.tables)
        over_m = None if tables is None else tables[1].height + self.settings.tables.clear_m
        off = stages.stance(self.seed, attempt.index, self.settings.variation.stance_spread)
        placement = replace(chosen, goal=poses.to_planar(poses.planar(*goal) @ poses.planar(*off)))
        attempt.placement = placement
        if self.task.turns_away(self.region):
            yield from stages.go_around(world, self.task, placement.goal, self.settings.walking)
        yield from stages.locomotion(world, placement.goal, self.settings.walking)
        handing_over = None if tables is None else self._handing_over(world, tables)
        playback = Playback(
            world, self.task, demonstration, self._segments, placement.symmetry, self.settings, over_m, handing_over
        )
        attempt.playback, attempt.stage = playback, playback.stage
        for wanted in playback.run():
            attempt.stage = playback.stage
            yield wanted
        if self.settings.adapts and playback.left_in_place:
            raise StageError("timeout", _missing(attempt, "the motion was over"), again=True)

    def _tables(self, world: WorldView) -> tuple[Table, Table] | None:
        """Return the demonstrated table and the one here, where the robot is to keep clear of it."""
        if self.region != WIDEST or not self.settings.adapts:
            return None
        return tables_under(world, self.task, self.demonstration, stages.first_approach(self._segments))

    def _handing_over(self, world: WorldView, tables: tuple[Table, Table]) -> HandingOver | None:
        """Return how hands keep to the way of a thing that one pushes onto the other, if one does."""
        pair = handed_over(self.demonstration, self._segments)
        if pair is None:
            return None
        return HandingOver(world, self.task, self.demonstration, pair, tables, self.settings.handing_over)

    def _conclude(self, attempt: Attempt, why: str) -> None:
        """Judge an attempt whose motion or time is over."""
        if self._judge.success_held[attempt.world.index]:
            attempt.end("success")
            return
        attempt.end("timeout", _missing(attempt, why))

    def _episode(self, attempt: Attempt) -> Episode:
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
            action=rows(attempt.action, command.SIZE),
            executed=None if attempt.noise is None else rows(attempt.executed, command.SIZE),
            success=np.array(attempt.success, dtype=bool),
            initial_state=copy.deepcopy(attempt.start),
            length_s=length * STEP_DT,
            reason=attempt.reason,
            stage_ticks=dict(Counter(attempt.stages)),
            fingerprints=attempt.trail.rows,
            digest=attempt.trail.digest,
            retries=attempt.retries,
            success_strict=attempt.strict,
        )


def _missing(attempt: Attempt, why: str) -> str:
    """Say in words what an attempt without success has ended with."""
    steps = sum(attempt.success)
    seen = f"held for {steps * STEP_DT:.1f} s, but not throughout the last second" if steps else "never held"
    return f"{why} and the success condition {seen}"


def _failure(attempt: Attempt, name: str) -> tuple[str, str]:
    """Return outcome and reason that a task's failure predicate stands for; before the hands take hold, it was hit."""
    reason = f"the task's failure condition {name!r} held"
    if attempt.stage != stages.MANIPULATION:
        return "collided", f"{reason} before the hands had taken hold: something was run into"
    return fault_outcome(name), reason


def _fall(world: WorldView, unstable: bool) -> str:
    """Say in words why a robot counts as fallen."""
    if unstable:
        return "the physics broke down: speeds beyond all bounds"
    pelvis = world.pose("pelvis")
    tilt = math.degrees(math.acos(float(np.clip(pelvis[2, 2], -1.0, 1.0))))
    return (
        f"the robot fell: pelvis {pelvis[2, 3]:.2f} m high and tilted by {tilt:.0f} deg (fallen is below "
        f"{FALLEN_HEIGHT:g} m or beyond {math.degrees(FALLEN_TILT):.0f} deg)"
    )


def attempt(
    task: Task, demonstration: Demonstration, region: str, seed: int, index: int, settings: Settings | None = None
) -> Episode:
    """Make one attempt: a function of its arguments and the installation; see ``Attempts``."""
    attempts = Attempts(task, demonstration, region, seed, settings=settings)
    try:
        return attempts.run([index])[0]
    finally:
        attempts.close()
