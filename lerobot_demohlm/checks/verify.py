"""A generated dataset -> its episodes simulated again and compared bit for bit.

Episodes are simulated from their stored starts and commands. What is compared, step by step: the observations and
success flags that the dataset holds, and the fingerprints of the whole simulation (physics, controller, contacts) that
``meta/episodes`` holds. All it takes is under ``meta/`` and ``data/``, so a dataset may have been pushed, pulled and
copied. What differs in the installation is printed first.

LeRobot's editing tools lose the fingerprints and the noise of the commands. An episode without them is generated again
from its demonstration, and compared with the frames and with the digest of its attempt.

Under other versions of what decides bits, or on another kind of processor, bits cannot agree. Then an episode agrees
where it ends as stored and its observations stay within ``BOUNDS``.
"""

import functools
import importlib
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.judge import held
from gym_demohlm.task import Task
from lerobot_demohlm.datasets import origin, reader
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import installed_versions, read_facts
from lerobot_demohlm.datasets.reader import ACTION, ENVIRONMENT_STATE, STATE, SUCCESS, StoredEpisode
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility import fingerprint, provenance
from lerobot_demohlm.reproducibility.fingerprint import Trail
from lerobot_demohlm.reproducibility.processes import end_with_parent

NUM_WORLDS = 16  # episodes side by side
SHOWN = 10  # differences printed


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """How far the repetition of an episode is from what is stored.

    Attributes:
        joints: Largest difference of a joint position or of the torso's tilt [rad].
        positions: Largest difference of an object's position in the camera frame [m].
        rotations: Largest difference of an entry of an object's rotation matrix.
        outcome: Whether it ended as stored: with success held for the last second, or without.
    """

    joints: float = 0.0
    positions: float = 0.0
    rotations: float = 0.0
    outcome: bool = True

    @property
    def within_bounds(self) -> bool:
        """Whether everything is within ``BOUNDS`` and the outcome is the stored one."""
        return self.outcome and all(
            getattr(self, name) <= getattr(BOUNDS, name) for name in ("joints", "positions", "rotations")
        )

    def __str__(self) -> str:
        """Return the numbers in words."""
        end = "ends as stored" if self.outcome else "ends otherwise than stored"
        return f"joints by up to {self.joints:.1e} rad, objects by up to {self.positions:.1e} m, {end}"


BOUNDS = Deviation(joints=0.05, positions=0.03, rotations=0.1)
"""Largest differences of an episode that agrees, under other versions or on another kind of processor.

Joint targets with relative errors of 1e-7 at every tick, as arithmetic that rounds otherwise has, moved 24 episodes of
eight tasks (R3, commands with noise) by up to 0.012 rad, 0.006 m and 0.025. All ended as before."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first thing in which an episode and its repetition differ.

    Attributes:
        episode: Index in the dataset.
        attempt: Index of the attempt in its run.
        step: Frame of the episode: its observation, its action or what the action led to.
        field: "start", "action", "physics", "controller", "contacts", a feature, "outcome" or "digest".
        detail: Both values, where the dataset holds values.
        deviation: Of the whole episode, under versions that may change bits; None where bits must agree.
    """

    episode: int
    attempt: int
    step: int
    field: str
    detail: str = ""
    deviation: Deviation | None = None

    @property
    def within_bounds(self) -> bool:
        """Whether bits may differ and the episode agrees within ``BOUNDS``."""
        return self.deviation is not None and self.deviation.within_bounds

    def __str__(self) -> str:
        """Return the line that is printed."""
        text = f"episode {self.episode} (attempt {self.attempt}) differs at step {self.step}: {self.field}"
        text = f"{text}, {self.detail}" if self.detail else text
        return text if self.deviation is None else f"{text}; {self.deviation}"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a verification found.

    Attributes:
        episodes: Episodes simulated again.
        steps: Their steps.
        mismatches: What differs in the installation, a line each.
        other_versions: What of it may change bits, a line each.
        differences: Of the episodes that differ, by episode.
    """

    episodes: int
    steps: int
    mismatches: tuple[str, ...]
    other_versions: tuple[str, ...]
    differences: tuple[Difference, ...]

    @property
    def identical(self) -> bool:
        """Whether every bit agrees."""
        return not self.differences

    @property
    def within_bounds(self) -> int:
        """Episodes that differ, but within the bounds that hold under other versions."""
        return sum(difference.within_bounds for difference in self.differences)

    @property
    def agrees(self) -> bool:
        """Whether every episode agrees: in every bit or, under versions that may change bits, within bounds."""
        return self.within_bounds == len(self.differences)

    def lines(self) -> list[str]:
        """Return the differences and the verdict in words."""
        wrong = [difference for difference in self.differences if not difference.within_bounds]
        said = [str(difference) for difference in wrong[:SHOWN]]
        if len(wrong) > SHOWN:
            said.append(f"and {len(wrong) - SHOWN} more")
        if self.identical:
            return [
                f"{self.episodes} episodes, {self.steps} steps: every bit as generated, "
                "observations, success, physics, controller and contacts"
            ]
        if self.other_versions:
            equal = self.episodes - len(self.differences)
            said.append(
                f"{self.episodes} episodes, {self.steps} steps: {equal} agree in every bit, {self.within_bounds} more "
                f"within the bounds for other versions (joints {BOUNDS.joints:g} rad, objects {BOUNDS.positions:g} m "
                f"and {BOUNDS.rotations:g} of their rotation, ending as stored), {len(wrong)} do not"
            )
        return said


def mismatches(facts: dict[str, Any], task: Task) -> tuple[str, ...]:
    """Return what differs between now and when a dataset was generated, a line each.

    Args:
        facts: ``meta/demohlm.json``.
        task: Its task.
    """
    now = {
        "controller": provenance.controller_hash(),
        "model": provenance.model_hash(build_scene(task).model),
        "code": provenance.code_hash(),
        **installed_versions(),
    }
    then = {name: facts.get(f"{name}_hash") for name in ("controller", "model", "code")} | facts["versions"]
    return tuple(
        f"{name} {str(then.get(name) or 'unknown')[:20]} when generated, {value[:20]} now"
        for name, value in now.items()
        if not _same(name, then.get(name), value)
    )


def _same(name: str, then: object, now: str) -> bool:
    return then == now or (name == "cpu" and isinstance(then, str) and provenance.kind_of_processor(then) == now)


def sources(root: Path) -> list[dict[str, Any]]:
    """Return the facts of every run that a dataset's episodes come from: one, but for edited datasets."""
    return origin.runs(origin.read_origins(root)) if origin.is_edited(root) else [read_facts(root)]


def verify(
    root: Path,
    task: Task,
    episodes: Sequence[int] | None = None,
    num_workers: int = 1,
    on_mismatches: Callable[[tuple[str, ...]], None] | None = None,
    show_progress: bool = False,
    demonstration: Path | None = None,
) -> Verification:
    """Simulate episodes again and compare.

    Args:
        root: Of a dataset of ``demohlm generate``, or of its failed attempts.
        task: Its task.
        episodes: Which, in any order; all by default.
        num_workers: Processes.
        on_mismatches: Called with what differs in the installation, before anything is simulated.
        show_progress: Draw a bar on stderr.
        demonstration: Directory of the demonstration that edited episodes are generated from again; the packaged one
            by default.

    Raises:
        DatasetError: The dataset is missing, damaged, of another task or version, or has no such episode.
    """
    facts, lengths = sources(root), reader.lengths(root)
    for run in facts:
        if run["task"] != task.name:
            raise DatasetError(f"a dataset of {run['task']}", f"one of {task.name}", "name its task")
    chosen = sorted(lengths if episodes is None else set(episodes))
    unknown = [episode for episode in chosen if episode not in lengths]
    if unknown or num_workers < 1:
        got = f"episode {unknown[0]}" if unknown else f"num_workers={num_workers}"
        raise DatasetError(got, f"episodes from 0 to {len(lengths) - 1} and 1 worker or more", "change the request")
    different = tuple(dict.fromkeys(line for run in facts for line in mismatches(run, task)))
    other_versions = tuple(dict.fromkeys(line for run in facts for line in provenance.bit_differences(run["versions"])))
    if on_mismatches is not None:
        on_mismatches(different)
    batches = [tuple(chosen[first : first + NUM_WORLDS]) for first in range(0, len(chosen), NUM_WORLDS)]
    differences: list[Difference] = []
    request = _Request(root=root, task=task.name, module=task.module, demonstration=demonstration)
    request = replace(request, bounded=bool(other_versions))
    with tqdm(total=len(chosen), desc="verify", unit="episode", disable=not show_progress) as bar:
        for batch, found in zip(batches, _run(request, task, batches, num_workers), strict=True):
            differences += found
            bar.update(len(batch))
    steps = sum(lengths[episode] for episode in chosen)
    return Verification(
        episodes=len(chosen),
        steps=steps,
        mismatches=different,
        other_versions=other_versions,
        differences=tuple(differences),
    )


@dataclass(frozen=True, kw_only=True)
class _Request:
    """What a worker needs to check batches.

    Attributes:
        root: Of the dataset.
        task: Name of its task.
        module: Which registers the task.
        demonstration: Directory of the demonstration; None for the packaged one.
        bounded: Whether to go on after a difference and measure how far the episode deviates.
    """

    root: Path
    task: str
    module: str
    demonstration: Path | None
    bounded: bool = False


class _Bench:
    """Simulates episodes of one task again, and keeps what that takes for the next batch.

    Args:
        request: What to check.
        task: The task.
        num_worlds: Episodes side by side.
    """

    def __init__(self, request: _Request, task: Task, num_worlds: int) -> None:
        self._request, self._task = request, task
        self._sim = Simulation(task, num_worlds=num_worlds)

    def check(self, batch: Sequence[int]) -> list[Difference]:
        """Check the episodes of one batch; returns the first difference of each that has one, by episode."""
        entries, bounded = reader.read(self._request.root, batch), self._request.bounded
        whole = [entry for entry in entries if entry.fingerprints is not None]
        found = compare(self._sim, whole, bounded) if whole else []
        found += self._generate([entry for entry in entries if entry.fingerprints is None])
        return sorted((each for each in found if each is not None), key=lambda each: each.episode)

    def _generate(self, entries: Sequence[StoredEpisode]) -> list[Difference | None]:
        """Generate edited episodes again, the attempts of one run side by side."""
        found: list[Difference | None] = []
        origins = origin.read_origins(self._request.root, [entry.episode for entry in entries]) if entries else {}
        for facts in origin.runs(origins):
            chosen = [entry for entry in entries if origins[entry.episode].facts == facts]
            source = demonstrations.load(self._request.demonstration, self._task)
            if source.content_hash != facts["demonstration_hash"]:
                raise DatasetError(
                    f"the demonstration {source.content_hash[:12]}",
                    f"{facts['demonstration_hash'][:12]}, which the run was made from",
                    "name its directory with --demonstration",
                )
            settings = Settings(variation=DataVariation.read(facts))
            attempts = Attempts(self._task, source, facts["region"], facts["seed"], settings=settings, sim=self._sim)
            again = attempts.run([entry.attempt for entry in chosen])
            found += [
                compare_again(self._task, entry, made, self._request.bounded)
                for entry, made in zip(chosen, again, strict=True)
            ]
        return found

    def close(self) -> None:
        """Release the simulation."""
        self._sim.close()


def _run(
    request: _Request, task: Task, batches: Sequence[tuple[int, ...]], num_workers: int
) -> Iterator[list[Difference]]:
    """Check batches here or in worker processes; yields in their order."""
    if num_workers == 1:
        bench = _Bench(request, task, min(NUM_WORLDS, max(map(len, batches), default=1)))
        yield from (bench.check(batch) for batch in batches)
        bench.close()
        return
    pool = ProcessPoolExecutor(num_workers, multiprocessing.get_context("spawn"), end_with_parent)
    try:
        yield from pool.map(functools.partial(_check_in_worker, request), batches)
    finally:
        pool.shutdown(cancel_futures=True)


def _check_in_worker(request: _Request, batch: tuple[int, ...]) -> list[Difference]:
    return _bench(request).check(batch)


@functools.lru_cache(maxsize=1)
def _bench(request: _Request) -> _Bench:
    importlib.import_module(request.module)  # registers a task from outside the package here too
    return _Bench(request, get_task(request.task), NUM_WORLDS)


def compare(sim: Simulation, episodes: Sequence[StoredEpisode], bounded: bool = False) -> list[Difference | None]:
    """Repeat episodes as worlds of one simulation, each until it ends or differs.

    Args:
        sim: With at least as many worlds.
        episodes: Of its task, with fingerprints.
        bounded: Whether to go on after a difference, and to measure the deviation of the whole episode.

    Returns:
        The first difference of each, None where every bit agrees.
    """
    sim.reset([entry.initial_state for entry in episodes], np.arange(len(episodes)))
    before = sim.snapshot()
    checks = [_Check(sim.task, entry, world, before, bounded) for world, entry in enumerate(episodes)]
    for step in range(max(len(entry) for entry in episodes)):
        state, environment_state = observation.agent_pos(sim), observation.environment_state(sim)
        for check in checks:
            check.before(step, state, environment_state)
        going = [check.world for check in checks if check.going(step)]
        if not going:
            break
        commands, active = sim.command, np.zeros(sim.num_worlds, dtype=bool)
        active[going] = True
        commands[going] = [episodes[world].commands[step] for world in going]
        sim.step(commands, active)
        after, success = sim.snapshot(), sim.success()
        for world in going:
            checks[world].after(step, after, success)
    return [check.result() for check in checks]


def deviation(entry: StoredEpisode, made: dict[str, np.ndarray], success: Sequence[bool] | np.ndarray) -> Deviation:
    """Return how far what was simulated is from an episode as stored.

    Args:
        entry: The episode, T frames.
        made: (T', D) of ``observation.state`` and ``observation.environment_state``, T' at most T.
        success: (T',) whether the task's condition held after each step.
    """
    count = len(success)
    state = np.abs(made[STATE].astype(np.float64) - entry.columns[STATE][:count])[:, _ANGLES]
    objects = np.abs(made[ENVIRONMENT_STATE].astype(np.float64) - entry.columns[ENVIRONMENT_STATE][:count])
    places = objects.reshape(count, -1, 9)  # position, then two columns of the rotation matrix
    as_stored = held(success) == (entry.outcome == "success")
    return Deviation(
        joints=float(state.max(initial=0.0)),
        positions=float(places[..., :3].max(initial=0.0)),
        rotations=float(places[..., 3:].max(initial=0.0)),
        outcome=bool(as_stored and count == len(entry)),
    )


_ANGLES = np.array([not name.endswith(".vel") for name in observation.STATE_NAMES])


def compare_again(task: Task, entry: StoredEpisode, made: Episode, bounded: bool = False) -> Difference | None:
    """Compare an episode with its attempt as it was generated again.

    Args:
        task: Of both.
        entry: The episode.
        made: Its attempt.
        bounded: Whether bits may differ, so that the deviation is measured.

    Returns:
        The first difference, None where every bit agrees.
    """
    again = {
        STATE: made.state,
        ENVIRONMENT_STATE: made.environment_state,
        ACTION: made.action,
        SUCCESS: made.success[:, None],
    }
    names = _names(task) | {ACTION: command.NAMES}
    count = min(len(entry), len(made.success))
    first: tuple[int, str, str] | None = None
    for feature, values in again.items():
        kept = entry.columns[feature][:count]
        rows, places = np.nonzero(kept != values[:count])
        if len(rows) and (first is None or rows[0] < first[0]):
            row, place = rows[0], places[0]
            detail = f"{names[feature][place]}: {kept[row, place]} stored, {values[row, place]} generated again"
            first = int(row), feature, detail
    if first is None and (made.outcome != entry.outcome or len(made.success) != len(entry)):
        ends = f"{entry.outcome} after {len(entry)} steps stored, {made.outcome} after {len(made.success)}"
        first = max(count - 1, 0), "outcome", ends
    if first is None and made.digest != entry.digest:
        first = max(count - 1, 0), "digest", "of the whole episode, though every frame agrees"
    if first is None:
        return None
    step, field, detail = first
    measured = None
    if bounded:
        measured = deviation(entry, {name: values[:count] for name, values in again.items()}, made.success[:count])
    return Difference(
        episode=entry.episode, attempt=entry.attempt, step=step, field=field, detail=detail, deviation=measured
    )


def _names(task: Task) -> dict[str, tuple[str, ...]]:
    """Return the names of the dimensions of what is simulated, by feature."""
    return {
        STATE: observation.STATE_NAMES,
        ENVIRONMENT_STATE: observation.environment_names(task),
        SUCCESS: ("success",),
    }


class _Check:
    """One episode against the world that repeats it.

    Args:
        task: The task.
        entry: The episode, with fingerprints.
        world: Which world repeats it.
        start: Snapshot of all worlds before the first action.
        bounded: Whether to go on after a difference.
    """

    def __init__(
        self, task: Task, entry: StoredEpisode, world: int, start: dict[str, np.ndarray], bounded: bool
    ) -> None:
        assert entry.fingerprints is not None  # others are generated again
        self.entry, self.world = entry, world
        self.difference: Difference | None = None
        self._fingerprints, self._bounded, self._broken = entry.fingerprints, bounded, False
        self._trail, self._success = Trail(), []
        self._seen: dict[str, list[np.ndarray]] = {STATE: [], ENVIRONMENT_STATE: []}
        self._names = _names(task)
        if (self._trail.add(start, world) != self._fingerprints[0]).any():
            self._differs(0, "start", "the simulation before the first action")

    def going(self, step: int) -> bool:
        """Tell whether the episode has this step and there is a reason to make it."""
        stopped = self._broken or (self.difference is not None and not self._bounded)
        return not stopped and step < len(self.entry)

    def before(self, step: int, state: np.ndarray, environment_state: np.ndarray) -> None:
        """Compare what is observed before an action, and look at the action itself."""
        for feature, simulated in ((STATE, state), (ENVIRONMENT_STATE, environment_state)):
            if self.going(step):
                self._seen[feature].append(simulated[self.world].copy())
                self._compare(step, feature, simulated)
        if self.going(step):
            broken = np.flatnonzero(~np.isfinite(self.entry.commands[step]))
            if len(broken):
                self._broken = True
                self._differs(step, "action", f"{command.NAMES[broken[0]]} is not a finite number")

    def after(self, step: int, snapshot: dict[str, np.ndarray], success: np.ndarray) -> None:
        """Compare what an action has led to."""
        row = self._trail.add(snapshot, self.world, self.entry.columns[ACTION][step])
        self._success.append(bool(success[self.world]))
        wrong = np.flatnonzero(row != self._fingerprints[step + 1])
        if len(wrong):
            self._differs(step, fingerprint.FIELDS[wrong[0]], "by its fingerprint")
        else:
            self._compare(step, SUCCESS, success[:, None])

    def result(self) -> Difference | None:
        """Compare what counts for the episode as a whole; returns its first difference."""
        last = max(len(self.entry) - 1, 0)
        if self.difference is None and self._trail.digest != self.entry.digest:
            self._differs(last, "digest", "of the whole episode, though every step agrees")
        if self.difference is None and self.entry.outcome == "success" and not held(self._success):
            self._differs(last, "outcome", "success stored, but it did not hold for the last second")
        if self.difference is None or not self._bounded:
            return self.difference
        count = len(self._success)
        seen = {name: np.array(rows[:count]).reshape(count, -1) for name, rows in self._seen.items()}
        return replace(self.difference, deviation=deviation(self.entry, seen, self._success))

    def _compare(self, step: int, feature: str, simulated: np.ndarray) -> None:
        """Compare a frame of a feature, whose rows are worlds, bit for bit."""
        kept, value = self.entry.columns[feature][step], simulated[self.world]
        if self.difference is not None or kept.tobytes() == value.tobytes():
            return
        first = next(i for i in range(len(kept)) if kept[i].tobytes() != value[i].tobytes())
        self._differs(step, feature, f"{self._names[feature][first]}: {kept[first]} stored, {value[first]} simulated")

    def _differs(self, step: int, field: str, detail: str) -> None:
        """Note a difference, if it is the first."""
        if self.difference is None:
            self.difference = Difference(
                episode=self.entry.episode, attempt=self.entry.attempt, step=step, field=field, detail=detail
            )


def choose(text: str, sample: int | None, total: int, seed: int) -> list[int]:
    """Return the episodes that ``--episodes`` and ``--sample`` ask for.

    Args:
        text: "all" or numbers with commas between them.
        sample: How many of them, drawn at random; all where None.
        total: Episodes in the dataset.
        seed: Of the draw.
    """
    if text == "all":
        chosen = list(range(total))
    else:
        try:
            chosen = [int(number) for number in text.split(",")]
        except ValueError:
            raise DatasetError(f"--episodes {text}", "all, or numbers such as 0,5,17", "correct it") from None
    if sample is None:
        return chosen
    if sample < 1:
        raise DatasetError(f"--sample {sample}", "1 or more", "correct it")
    drawn = np.random.default_rng(seed).permutation(len(chosen))[:sample]
    return sorted(chosen[position] for position in drawn)
