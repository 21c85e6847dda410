"""A generated dataset -> its episodes simulated again from their stored starts and commands, compared bit for bit.

What is compared, step by step: the observations and success flags that the dataset holds, and the fingerprints of the
whole simulation (physics, controller, contacts) that ``meta/episodes`` holds. All it takes is under ``meta/`` and
``data/``, so a dataset may have been pushed, pulled and copied. What differs in the installation is said first.
"""

import argparse
import functools
import importlib
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
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
from lerobot_demohlm.datasets import reader
from lerobot_demohlm.datasets.facts import installed_versions, read_facts
from lerobot_demohlm.datasets.reader import ACTION, ENVIRONMENT_STATE, STATE, SUCCESS, StoredEpisode
from lerobot_demohlm.reproducibility import fingerprint, provenance
from lerobot_demohlm.reproducibility.fingerprint import Trail
from lerobot_demohlm.reproducibility.processes import end_with_parent

NUM_WORLDS = 16  # episodes side by side
SHOWN = 10  # differences printed


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first thing in which an episode and its repetition differ.

    Attributes:
        episode: Index in the dataset.
        attempt: Index of the attempt in its run.
        step: Frame of the episode: its observation, its action or what the action led to.
        field: "start", "action", "physics", "controller", "contacts", a feature, "outcome" or "digest".
        detail: Both values, where the dataset holds values.
    """

    episode: int
    attempt: int
    step: int
    field: str
    detail: str = ""

    def __str__(self) -> str:
        """Return the line that is printed."""
        text = f"episode {self.episode} (attempt {self.attempt}) differs at step {self.step}: {self.field}"
        return f"{text}, {self.detail}" if self.detail else text


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a verification found.

    Attributes:
        episodes: Episodes simulated again.
        steps: Their steps.
        mismatches: What differs in the installation, a line each.
        differences: Of the episodes that differ, by episode.
    """

    episodes: int
    steps: int
    mismatches: tuple[str, ...]
    differences: tuple[Difference, ...]

    @property
    def identical(self) -> bool:
        """Whether every bit agrees."""
        return not self.differences


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
        if then.get(name) != value
    )


def verify(
    root: Path,
    task: Task,
    episodes: Sequence[int] | None = None,
    num_workers: int = 1,
    on_mismatches: Callable[[tuple[str, ...]], None] | None = None,
    show_progress: bool = False,
) -> Verification:
    """Simulate episodes again and compare.

    Args:
        root: Of a dataset of ``demohlm generate``, or of its failed attempts.
        task: Its task.
        episodes: Which, in any order; all by default.
        num_workers: Processes.
        on_mismatches: Called with what differs in the installation, before anything is simulated.
        show_progress: Draw a bar on stderr.

    Raises:
        DatasetError: The dataset is missing, damaged, of another task or version, or has no such episode.
    """
    facts, lengths = read_facts(root), reader.lengths(root)
    if facts["task"] != task.name:
        raise DatasetError(f"a dataset of {facts['task']}", f"one of {task.name}", "name its task")
    chosen = sorted(lengths if episodes is None else set(episodes))
    unknown = [episode for episode in chosen if episode not in lengths]
    if unknown or num_workers < 1:
        got = f"episode {unknown[0]}" if unknown else f"num_workers={num_workers}"
        raise DatasetError(got, f"episodes from 0 to {len(lengths) - 1} and 1 worker or more", "change the request")
    different = mismatches(facts, task)
    if on_mismatches is not None:
        on_mismatches(different)
    batches = [tuple(chosen[first : first + NUM_WORLDS]) for first in range(0, len(chosen), NUM_WORLDS)]
    differences: list[Difference] = []
    with tqdm(total=len(chosen), desc="verify", unit="episode", disable=not show_progress) as bar:
        for batch, found in zip(batches, _run(root, task, batches, num_workers), strict=True):
            differences += found
            bar.update(len(batch))
    steps = sum(lengths[episode] for episode in chosen)
    return Verification(episodes=len(chosen), steps=steps, mismatches=different, differences=tuple(differences))


def _run(root: Path, task: Task, batches: Sequence[tuple[int, ...]], num_workers: int) -> Iterator[list[Difference]]:
    """Check batches here or in worker processes; yields in their order."""
    if num_workers == 1:
        sim = Simulation(task, num_worlds=min(NUM_WORLDS, max(map(len, batches), default=1)))
        yield from (_check(root, sim, batch) for batch in batches)
        sim.close()
        return
    work = functools.partial(_check_in_worker, root, task.module, task.name)
    pool = ProcessPoolExecutor(num_workers, multiprocessing.get_context("spawn"), end_with_parent)
    try:
        yield from pool.map(work, batches)
    finally:
        pool.shutdown(cancel_futures=True)


def _check(root: Path, sim: Simulation, batch: tuple[int, ...]) -> list[Difference]:
    """Check the episodes of one batch side by side; returns the first difference of each that has one."""
    found = compare(sim, reader.read(root, batch))
    return [difference for difference in found if difference is not None]


def _check_in_worker(root: Path, task_module: str, task_name: str, batch: tuple[int, ...]) -> list[Difference]:
    return _check(root, _simulation(task_module, task_name), batch)


@functools.lru_cache(maxsize=1)
def _simulation(task_module: str, task_name: str) -> Simulation:
    importlib.import_module(task_module)  # registers a task from outside the package here too
    return Simulation(get_task(task_name), num_worlds=NUM_WORLDS)


def compare(sim: Simulation, episodes: Sequence[StoredEpisode]) -> list[Difference | None]:
    """Repeat episodes as worlds of one simulation, each until it ends or differs.

    Args:
        sim: With at least as many worlds.
        episodes: Of its task.

    Returns:
        The first difference of each, None where every bit agrees.
    """
    sim.reset([entry.initial_state for entry in episodes], np.arange(len(episodes)))
    before = sim.snapshot()
    checks = [_Check(sim.task, entry, world, before) for world, entry in enumerate(episodes)]
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


class _Check:
    """One episode against the world that repeats it.

    Args:
        task: The task.
        entry: The episode.
        world: Which world repeats it.
        start: Snapshot of all worlds before the first action.
    """

    def __init__(self, task: Task, entry: StoredEpisode, world: int, start: dict[str, np.ndarray]) -> None:
        self.entry, self.world = entry, world
        self.difference: Difference | None = None
        self._trail, self._success = Trail(), []
        self._names = {
            STATE: observation.STATE_NAMES,
            ENVIRONMENT_STATE: observation.environment_names(task),
            SUCCESS: ("success",),
        }
        if (self._trail.add(start, world) != entry.fingerprints[0]).any():
            self._differs(0, "start", "the simulation before the first action")

    def going(self, step: int) -> bool:
        """Tell whether the episode has this step and has not differed."""
        return self.difference is None and step < len(self.entry)

    def before(self, step: int, state: np.ndarray, environment_state: np.ndarray) -> None:
        """Compare what is observed before an action, and look at the action itself."""
        if self.going(step):
            self._compare(step, STATE, state)
        if self.going(step):
            self._compare(step, ENVIRONMENT_STATE, environment_state)
        if self.going(step):
            broken = np.flatnonzero(~np.isfinite(self.entry.commands[step]))
            if len(broken):
                self._differs(step, "action", f"{command.NAMES[broken[0]]} is not a finite number")

    def after(self, step: int, snapshot: dict[str, np.ndarray], success: np.ndarray) -> None:
        """Compare what an action has led to."""
        row = self._trail.add(snapshot, self.world, self.entry.columns[ACTION][step])
        self._success.append(bool(success[self.world]))
        wrong = np.flatnonzero(row != self.entry.fingerprints[step + 1])
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
        return self.difference

    def _compare(self, step: int, feature: str, simulated: np.ndarray) -> None:
        """Compare a frame of a feature, whose rows are worlds, bit for bit."""
        kept, value = self.entry.columns[feature][step], simulated[self.world]
        if kept.tobytes() == value.tobytes():
            return
        first = next(i for i in range(len(kept)) if kept[i].tobytes() != value[i].tobytes())
        self._differs(step, feature, f"{self._names[feature][first]}: {kept[first]} stored, {value[first]} simulated")

    def _differs(self, step: int, field: str, detail: str) -> None:
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm verify``."""
    parser.add_argument("--root", type=Path, required=True, help="dataset of `demohlm generate`, or its failures")
    parser.add_argument("--task", help="my_module:MyTask, for a task from outside the package")
    parser.add_argument("--episodes", default="all", help="all, or numbers such as 0,5,17 (default: %(default)s)")
    parser.add_argument("--sample", type=int, help="verify this many of them, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of that draw (default: %(default)s)")
    parser.add_argument("--num-workers", type=int, default=1, help="processes (default: %(default)s)")


def main(arguments: argparse.Namespace) -> int:
    """Verify a dataset; exit code 1 where any bit differs. The last line on stdout is a JSON object."""
    root: Path = arguments.root
    task = get_task(arguments.task or read_facts(root)["task"])
    began = time.monotonic()
    chosen = choose(arguments.episodes, arguments.sample, len(reader.lengths(root)), arguments.seed)
    outcome = verify(root, task, chosen, arguments.num_workers, _say, show_progress=True)
    for difference in outcome.differences[:SHOWN]:
        print(difference)
    if len(outcome.differences) > SHOWN:
        print(f"and {len(outcome.differences) - SHOWN} more")
    if outcome.identical:
        print(
            f"{outcome.episodes} episodes, {outcome.steps} steps: every bit as generated, "
            "observations, success, physics, controller and contacts"
        )
    content = asdict(outcome) | {"identical": outcome.identical, "episodes_that_differ": len(outcome.differences)}
    content["differences"] = content["differences"][:SHOWN]
    content["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(content))
    return 0 if outcome.identical else 1


def _say(different: tuple[str, ...]) -> None:
    for line in different:
        print(line, flush=True)
    if different:
        print("bits hold for one installation and one family of processors: this alone may change them", flush=True)
