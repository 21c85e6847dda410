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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.checks.difference import BOUNDS, Difference
from lerobot_demohlm.checks.pictures import PictureCheck
from lerobot_demohlm.checks.repetition import compare, compare_again
from lerobot_demohlm.datasets import origin, reader
from lerobot_demohlm.datasets.cameras import PictureFacts
from lerobot_demohlm.datasets.facts import PERCEPTION_FIT, installed_versions, perception_fit, read_facts
from lerobot_demohlm.datasets.reader import StoredEpisode
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.processes import end_with_parent

NUM_WORLDS = 16  # episodes side by side
SHOWN = 10  # differences printed


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a verification found.

    Attributes:
        episodes: Episodes simulated again.
        steps: Their steps.
        mismatches: What differs in the installation, a line each.
        other_versions: What of it may change bits, a line each.
        differences: Of the episodes that differ, by episode.
        pictures_unseen: Episodes that agree and whose pictures were not compared: those of edited datasets, and those
            whose states differ within bounds.
    """

    episodes: int
    steps: int
    mismatches: tuple[str, ...]
    other_versions: tuple[str, ...]
    differences: tuple[Difference, ...]
    pictures_unseen: int = 0

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
        if self.pictures_unseen:
            said.append(f"the pictures of {self.pictures_unseen} episodes were not compared")
        if self.identical:
            return [
                *said,
                f"{self.episodes} episodes, {self.steps} steps: every bit as generated, "
                "observations, success, physics, controller and contacts",
            ]
        if self.other_versions:
            equal = self.episodes - len(self.differences)
            said.append(
                f"{self.episodes} episodes, {self.steps} steps: {equal} agree in every bit, {self.within_bounds} more "
                f"within the bounds for other versions (joints {BOUNDS.joints:g} rad, objects {BOUNDS.positions:g} m "
                f"and {BOUNDS.rotations:g} of their rotation, ending as stored), {len(wrong)} do not"
            )
        return said


def mismatches(facts: dict[str, Any], task: Task, controller: str | None = None) -> tuple[str, ...]:
    """Return what differs between now and when a dataset was generated, a line each.

    Args:
        facts: ``meta/demohlm.json``.
        task: Its task.
        controller: That it is simulated with; by default the one that it was generated with, if it is installed.
    """
    weights = controllers.load(controller or controllers.recorded(facts.get("controller_hash")) or controllers.DEFAULT)
    now = {
        "controller": weights.hash,
        "model": provenance.model_hash(build_scene(task.at(facts["region"]), weights.settings.physics).model),
        "code": provenance.code_hash(),
        **installed_versions(),
    }
    then = {name: facts.get(f"{name}_hash") for name in ("controller", "model", "code")} | facts["versions"]
    if facts.get(PERCEPTION_FIT):
        now, then = now | {PERCEPTION_FIT: perception_fit(task, facts)}, then | {PERCEPTION_FIT: facts[PERCEPTION_FIT]}
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
    controller: str | None = None,
) -> Verification:
    """Simulate episodes again and compare.

    The robots have the controller that the episodes were generated with, where it is installed, and else the default.

    Args:
        root: Of a dataset of ``demohlm generate``, or of its failed attempts.
        task: Its task.
        episodes: Which, in any order; all by default.
        num_workers: Processes.
        on_mismatches: Called with what differs in the installation, before anything is simulated.
        show_progress: Draw a bar on stderr.
        demonstration: Directory of the demonstration that edited episodes are generated from again; the packaged one
            by default.
        controller: Name, path or hash of another controller for all episodes.

    Raises:
        UnknownNameError: No such controller.
        DatasetError: The dataset is missing, damaged, of another task or version, or has no such episode.
    """
    facts, lengths = sources(root), reader.lengths(root)
    for run in facts:
        if run["task"] != task.name:
            raise DatasetError(
                f"a dataset of {run['task']}", f"one of {task.name}", "name its task, or leave --task out"
            )
    chosen = sorted(lengths if episodes is None else set(episodes))
    unknown = [episode for episode in chosen if episode not in lengths]
    if unknown or num_workers < 1:
        got = f"episode {unknown[0]}" if unknown else f"num_workers={num_workers}"
        raise DatasetError(got, f"episodes from 0 to {len(lengths) - 1} and 1 worker or more", "change the request")
    different = tuple(dict.fromkeys(line for run in facts for line in mismatches(run, task, controller)))
    other_versions = tuple(dict.fromkeys(line for run in facts for line in provenance.bit_differences(run["versions"])))
    if on_mismatches is not None:
        on_mismatches(different)
    batches = [tuple(chosen[first : first + NUM_WORLDS]) for first in range(0, len(chosen), NUM_WORLDS)]
    differences: list[Difference] = []
    request = _Request(
        root=root,
        task=task.name,
        module=task.module,
        demonstration=demonstration,
        controller=controller,
        bounded=bool(other_versions),
    )
    with tqdm(total=len(chosen), desc="verify", unit="episode", disable=not show_progress) as bar:
        for batch, found in zip(batches, _run(request, task, batches, num_workers), strict=True):
            differences += found
            bar.update(len(batch))
    steps = sum(lengths[episode] for episode in chosen)
    unseen = 0
    if reader.has_videos(root):
        bounded = sum(difference.within_bounds for difference in differences)
        unseen = len(chosen) if origin.is_edited(root) else bounded
    return Verification(
        episodes=len(chosen),
        steps=steps,
        mismatches=different,
        other_versions=other_versions,
        differences=tuple(differences),
        pictures_unseen=unseen,
    )


@dataclass(frozen=True, kw_only=True)
class _Request:
    """What a worker needs to check batches.

    Attributes:
        root: Of the dataset.
        task: Name of its task.
        module: Which registers the task.
        demonstration: Directory of the demonstration; None for the packaged one.
        controller: Name, path or hash of a controller; None for the one that each episode was generated with.
        bounded: Whether to go on after a difference and measure how far the episode deviates.
    """

    root: Path
    task: str
    module: str
    demonstration: Path | None
    controller: str | None = None
    bounded: bool = False


class _Bench:
    """Simulates episodes of one task again, and keeps what that takes for the next batch.

    Args:
        request: What to check.
        task: The task.
        num_worlds: Episodes side by side.
    """

    def __init__(self, request: _Request, task: Task, num_worlds: int) -> None:
        self._request, self._task, self._num_worlds = request, task, num_worlds
        self._sims: dict[tuple[str, str, str], Simulation] = {}  # by controller, variation and region

    def check(self, batch: Sequence[int]) -> list[Difference]:
        """Check the episodes of one batch; returns the first difference of each that has one, by episode."""
        root, bounded = self._request.root, self._request.bounded
        entries, found = reader.read(root, batch), []
        edited = [entry for entry in entries if entry.fingerprints is None]
        for facts, whole in self._by_run([entry for entry in entries if entry.fingerprints is not None]):
            found += self._repeat(facts, whole, bounded)
        for facts, again in self._by_run(edited):
            found += self._generate(facts, again)
        return sorted((each for each in found if each is not None), key=lambda each: each.episode)

    def _repeat(
        self, facts: dict[str, Any], entries: Sequence[StoredEpisode], bounded: bool
    ) -> list[Difference | None]:
        """Simulate episodes of one run again, and draw them again where the dataset has pictures."""
        sim, seen, check = self._sim(facts), DataVariation.read(facts).perception, self._pictures
        if check is None:
            return compare(sim, entries, bounded, perception=seen)
        check.recorder.clear()
        found = compare(sim, entries, bounded, check.recorder, seen)
        return found + check.compare(entries, [world for world, each in enumerate(found) if each is None])

    @functools.cached_property
    def _pictures(self) -> PictureCheck | None:
        root = self._request.root
        facts = read_facts(root)
        if origin.is_edited(root) or not PictureFacts.read(facts).cameras or not reader.has_videos(root):
            return None
        return PictureCheck(root, self._task.at(facts["region"]), facts)

    def _by_run(self, entries: Sequence[StoredEpisode]) -> list[tuple[dict[str, Any], list[StoredEpisode]]]:
        """Return the facts of each run that episodes come from, and these episodes."""
        root = self._request.root
        if not entries:
            return []
        if not origin.is_edited(root):
            return [(read_facts(root), list(entries))]
        origins = origin.read_origins(root, [entry.episode for entry in entries])
        runs = origin.runs(origins)
        return [(facts, [entry for entry in entries if origins[entry.episode].facts == facts]) for facts in runs]

    def _sim(self, facts: dict[str, Any]) -> Simulation:
        name = self._request.controller or controllers.recorded(facts.get("controller_hash")) or controllers.DEFAULT
        key = name, DataVariation.read(facts).variation, facts["region"]
        if key not in self._sims:
            varied = get_variation(key[1])
            task = self._task.at(facts["region"])
            self._sims[key] = Simulation(task, self._num_worlds, controller=name, variation=varied)
        return self._sims[key]

    def _generate(self, facts: dict[str, Any], entries: Sequence[StoredEpisode]) -> list[Difference | None]:
        """Generate edited episodes of one run again, side by side."""
        source = demonstrations.load(self._request.demonstration, self._task)
        if source.content_hash != facts["demonstration_hash"]:
            raise DatasetError(
                f"the demonstration {source.content_hash[:12]}",
                f"{facts['demonstration_hash'][:12]}, which the run was made from",
                "name its directory with --demonstration",
            )
        settings, sim = Settings(variation=DataVariation.read(facts)), self._sim(facts)
        attempts = Attempts(self._task, source, facts["region"], facts["seed"], settings=settings, sim=sim)
        try:
            again = attempts.run([entry.attempt for entry in entries])
        finally:
            attempts.close_eyes()
        return [
            compare_again(self._task, entry, made, self._request.bounded)
            for entry, made in zip(entries, again, strict=True)
        ]

    def close(self) -> None:
        """Release the simulations, and what draws pictures."""
        for sim in self._sims.values():
            sim.close()
        drawn = vars(self).get("_pictures")  # not made for this alone
        if drawn is not None:
            drawn.close()


def _run(
    request: _Request, task: Task, batches: Sequence[tuple[int, ...]], num_workers: int
) -> Iterator[list[Difference]]:
    """Check batches here or in worker processes; yields in their order."""
    if num_workers == 1:
        bench = _Bench(request, task, min(NUM_WORLDS, max(map(len, batches), default=1)))
        try:
            yield from (bench.check(batch) for batch in batches)
        finally:
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
