"""Turns blocks of attempts, computed by any worker in any order, into one dataset in the order of the attempts.

On disk, beside the future root::

    <root>.partial/run.json      the facts of the run and hashes of the code: a resumed run must have the same
    <root>.partial/lock          held by the process that is at work
    <root>.partial/blocks/       one directory a block, see ``block.py``
    <root>.partial/finished/     the merged datasets, on their way to the root
    .<root>.removed/             what was <root>.partial, once all is at the root, until it is deleted

A block is a function of the facts and its attempts alone, so a run that was killed and resumed ends in the same files
as one that never was, and so does one with more workers. The blocks on disk are the manifest: nothing can disagree
with them, and each says by checksums whether it is whole. One that is not is removed and made again.
"""

import itertools
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError, NoSuccessError
from gym_demohlm.files import replace_text
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets.facts import (
    GenerationFacts,
    count_outcomes,
    read_facts,
    read_records,
    require_new_root,
    write_facts,
)
from lerobot_demohlm.generation.block import RECORDS, block_directory, read_block, storing
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.run_lock import RunLock

_CODE, _GENERATOR, _TASK = "code_hash", "generator_hash", "task_hash"
HOPELESS_ATTEMPTS = 512  # a run with a target of episodes gives up after so many attempts without a success
_log = logging.getLogger(__name__)


def partial_directory(root: Path) -> Path:
    """Return where a run keeps its blocks until it is finished."""
    return root.with_name(root.name + ".partial")


def _remains(root: Path) -> Path:
    """Return where a finished run's partial directory goes to be deleted: half of one is no run to go on with."""
    return root.with_name(f".{root.name}.removed")


def made_so_far(directory: Path) -> list[dict[str, Any]]:
    """Return the attempts of the blocks in a partial directory, also behind gaps.

    Raises:
        DatasetError: There are none, or a block is damaged.
    """
    blocks = sorted((directory / "blocks").glob("[0-9]*"))
    records = [record for block in blocks for record in read_records(block / RECORDS)]
    if not records:
        raise DatasetError(f"{directory} without a finished block", "some attempts", "wait until there are some")
    return records


def failures_root(root: Path) -> Path:
    """Return where the failed attempts of a run go, if they are kept."""
    return root.with_name(root.name + "-failures")


@dataclass(frozen=True, kw_only=True, eq=False)
class GenerationRun:
    """A generation run on disk, begun or resumed; see ``datasets/facts.py`` for the order in which it is used."""

    root: Path
    repo_id: str
    facts: GenerationFacts
    lock: RunLock
    _successes: dict[int, int] = field(default_factory=dict)
    """Successes of each block on disk, by its first attempt."""

    @classmethod
    def open(cls, root: Path, repo_id: str, facts: GenerationFacts, *, resume: bool = False) -> "GenerationRun":
        """Begin a run, or go on with the one that was killed; no other process can until ``close`` or the end of this.

        Args:
            root: Of the dataset.
            repo_id: Name of the dataset on the hub.
            facts: What the run is a function of.
            resume: Refuse to begin a run: there must be one to go on with.

        Raises:
            DatasetError: The root exists, a run with other facts was begun there, another process is at work on it, it
                cannot be written, or nothing was begun where ``resume`` asks for it.
        """
        root = Path(root)
        directory = partial_directory(root)
        shutil.rmtree(_remains(root), ignore_errors=True)  # of a run that was stopped while it did so
        _require_new_targets(root, facts)
        if resume and not (directory / "run.json").exists():
            raise DatasetError(f"{directory} without a run", "one to go on with", "leave --resume out to begin one")
        with storing(directory):
            (directory / "blocks").mkdir(parents=True, exist_ok=True)
            run = cls(root=root, repo_id=repo_id, facts=facts, lock=RunLock(directory))
            try:
                run._take_up()
            except BaseException:
                run.close()
                raise
        return run

    def _take_up(self) -> None:
        """Write the facts or compare them, remove what is half-written or damaged, and count what is there."""
        _require_new_targets(self.root, self.facts)  # another process may have finished it just before the lock
        path = self.directory / "run.json"
        if path.exists():
            _require_same_facts(path, self.facts)
        else:
            replace_text(path, json.dumps(_begun_with(self.facts), indent=2) + "\n")
        for block in sorted((self.directory / "blocks").iterdir()):
            if block.name.startswith("."):
                shutil.rmtree(block, ignore_errors=True)
            elif block.name.isdecimal() and int(block.name) % self.facts.block_size == 0:
                self.is_done(self.attempts_of_block(int(block.name) // self.facts.block_size))

    def close(self) -> None:
        """Let other processes open the run."""
        self.lock.release()

    @property
    def directory(self) -> Path:
        """Where the blocks are."""
        return partial_directory(self.root)

    @property
    def _finished(self) -> Path:
        return self.directory / "finished"

    @property
    def num_attempts(self) -> int:
        """Attempts on disk, also behind gaps."""
        return sum(len(self.attempts_of_block(start // self.facts.block_size)) for start in self._successes)

    @property
    def num_successes(self) -> int:
        """Successes among them."""
        return sum(self._successes.values())

    def attempts_of_block(self, block: int) -> range:
        """Return the indices of the attempts of a block."""
        start, size = block * self.facts.block_size, self.facts.block_size
        stop = start + size if self.facts.num_attempts is None else min(start + size, self.facts.num_attempts)
        return range(start, stop)

    def is_done(self, attempts: range) -> bool:
        """Tell whether a block is on disk and whole; one that is damaged is removed, with a warning."""
        if attempts.start in self._successes:
            return True
        block = block_directory(self.directory, attempts)
        if not block.exists():
            return False
        try:
            records = read_block(self.directory, self.facts, attempts)
        except DatasetError as error:
            _log.warning("%s", error)
            shutil.rmtree(block)
            return False
        self._successes[attempts.start] = sum(record["outcome"] == "success" for record in records)
        return True

    def target_met(self) -> bool:
        """Tell whether the blocks on disk up to the first missing one are enough."""
        if self._finished.is_dir():
            return True
        attempts = successes = 0
        for block in itertools.count():
            if self._enough(attempts, successes):
                return True
            indices = self.attempts_of_block(block)
            if not self.is_done(indices):
                return False
            attempts, successes = attempts + len(indices), successes + self._successes[indices.start]
        raise AssertionError  # counting does not end

    def records(self) -> list[dict[str, Any]]:
        """Return the attempts on disk up to the first block that is missing, cut off where the target is met.

        Raises:
            DatasetError: A block has been damaged.
        """
        records: list[dict[str, Any]] = []
        successes = 0
        for block in itertools.count():
            attempts = self.attempts_of_block(block)
            if self._enough(len(records), successes) or not block_directory(self.directory, attempts).exists():
                return records
            for record in read_block(self.directory, self.facts, attempts):
                if not self._enough(len(records), successes):
                    records.append(record)
                    successes += record["outcome"] == "success"
        raise AssertionError  # counting does not end

    def pending_blocks(self) -> Iterator[range]:
        """Yield the attempts of blocks that are to be computed, in order, until those on disk meet the target.

        The generator looks at the disk each time it is asked. So a runner that draws the next block when a worker is
        free computes at most as many blocks past a ``num_episodes`` target as it has further workers.
        """
        for block in itertools.count():
            if self.target_met():
                return
            attempts = self.attempts_of_block(block)
            is_new = attempts.start > max(self._successes, default=-1)
            if len(attempts) == 0 or (is_new and self._enough(0, self.num_successes)):
                return  # once the gaps before it are filled, which somebody is at
            if not self.is_done(attempts):
                yield attempts

    def finish(self, progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
        """Merge the blocks into the dataset at the root and remove the partial directory.

        Args:
            progress: Called with (blocks merged, blocks in all).

        Returns:
            The content of ``meta/demohlm.json``.

        Raises:
            NoSuccessError: Not one attempt succeeded.
            DatasetError: The target is not met yet, a block has been damaged, or the disk is full.

        What has been made is kept in the partial directory then.
        """
        with storing(self.directory):
            if not self._finished.is_dir():
                self._merge(progress).rename(self._finished)
            _require_new_targets(self.root, self.facts)
            for name, target in _targets(self.root, self.facts):
                if (self._finished / name).exists():
                    (self._finished / name).rename(target)
            self.directory.rename(_remains(self.root))
        self.close()
        shutil.rmtree(_remains(self.root), ignore_errors=True)
        return read_facts(self.root)

    def _merge(self, progress: Callable[[int, int], None] | None) -> Path:
        """Merge the blocks into datasets in one directory, which is returned."""
        records = self.records()
        if not self._enough(len(records), count_outcomes(records)["success"]):
            raise DatasetError(
                f"{len(records)} attempts in a row in {self.directory}", "enough for the target", "resume the run"
            )
        if not any(record["outcome"] == "success" for record in records):
            counts = ", ".join(f"{n} {name}" for name, n in count_outcomes(records).items() if n)
            why = f"see why: demohlm explain --root {self.directory} --output why.html"
            raise NoSuccessError(f"no success in {len(records)} attempts ({counts})", "one or more", why)
        from lerobot_demohlm.datasets import merge  # takes seconds
        from lerobot_demohlm.datasets.card import write_card

        merged = self.directory / "merged"
        shutil.rmtree(merged, ignore_errors=True)
        merged.mkdir()
        for name in ("episodes", "failures"):
            parts = self._parts(name, records, merged)
            if not parts:
                continue
            merge.merge(parts, self.repo_id, merged / name, progress if name == "episodes" else None)
            content = write_facts(merged / name, self.facts, records)
            write_card(merged / name, self.repo_id, content)
        return merged

    def _enough(self, attempts: int, successes: int) -> bool:
        if self.facts.num_attempts is not None:
            return attempts >= self.facts.num_attempts
        hopeless = successes == 0 and attempts >= HOPELESS_ATTEMPTS  # else it would never end
        return hopeless or successes >= (self.facts.num_episodes or 0)

    def _parts(self, name: str, records: Sequence[dict[str, Any]], scratch: Path) -> list[Path]:
        """Return the roots of the blocks' datasets in order, the last one cut off behind the last record."""
        from lerobot_demohlm.datasets import merge

        wanted = {record["attempt"] for record in records}
        parts = []
        for block in range(-(-len(records) // self.facts.block_size)):
            attempts = self.attempts_of_block(block)
            part = block_directory(self.directory, attempts) / name
            if not part.exists():
                continue
            held = [r for r in read_block(self.directory, self.facts, attempts) if _belongs(r, name)]
            kept = sum(record["attempt"] in wanted for record in held)
            if kept == len(held):
                parts.append(part)
            elif kept > 0:
                parts.append(merge.first_episodes(part, scratch / f"cut-{name}", held[:kept], self.facts))
        return parts


def _targets(root: Path, facts: GenerationFacts) -> list[tuple[str, Path]]:
    """Return the names of the merged datasets and where they go; the dataset itself last: then the run is over."""
    failures = [("failures", failures_root(root))] if facts.keep_failures else []
    return [*failures, ("episodes", root)]


def _require_new_targets(root: Path, facts: GenerationFacts) -> None:
    """Raise ``DatasetError`` where something is that this run is yet to put there."""
    finished = partial_directory(root) / "finished"
    for name, target in _targets(root, facts):
        if not finished.is_dir() or (finished / name).exists():
            require_new_root(target)


def _begun_with(facts: GenerationFacts) -> dict[str, Any]:
    """Return what a run must have been begun with to be resumed: its facts, and the code that makes its blocks."""
    outside = provenance.task_hash(get_task(facts.task))
    code = {_CODE: provenance.code_hash(), _GENERATOR: provenance.generator_hash()}
    return facts.content() | code | ({_TASK: outside} if outside else {})


def _require_same_facts(path: Path, facts: GenerationFacts) -> None:
    """Raise ``DatasetError`` where a run was begun with other facts, or by other code."""
    try:
        begun = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        begun = error
    if not isinstance(begun, dict):
        raise DatasetError(
            f"{path}, damaged ({begun})", "the facts of a run", f"remove {path.parent}, or choose another --root"
        )
    now = json.loads(json.dumps(_begun_with(facts)))
    different = sorted(key for key in begun.keys() | now.keys() if begun.get(key) != now.get(key))
    if different and set(different) <= {_CODE, _GENERATOR, _TASK}:
        what = f"the file of {facts.task}" if different == [_TASK] else "this package"
        raise DatasetError(
            f"{path.parent}, begun by another version of {what}",
            f"this version, {' and '.join(now[key][:8] for key in (_CODE, _GENERATOR, _TASK) if key in now)}",
            "resume it with that version, or remove it, or choose another --root",
        )
    if different:
        key = different[0]
        raise DatasetError(
            f"{path.parent}, begun with {key}={begun.get(key)}",
            f"{key}={now.get(key)}, as asked for now",
            "resume it with the same arguments, or remove it, or choose another --root",
        )


def _belongs(record: dict[str, Any], name: str) -> bool:
    """Tell whether an attempt is in its block's ``episodes`` or ``failures`` dataset."""
    succeeded = record["outcome"] == "success"
    return succeeded if name == "episodes" else not succeeded and record["frames"] > 0
