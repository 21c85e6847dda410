"""Turns blocks of attempts, computed by any worker in any order, into one dataset in the order of the attempts.

On disk, beside the future root::

    <root>.partial/run.json              the facts of the run: a resumed run must have the same
    <root>.partial/blocks/0000016/       attempts 16 to 23, finalized; appears by one rename
        attempts.jsonl                   one line an attempt
        episodes/                        LeRobot dataset of the successes, if any
        failures/                        LeRobot dataset of the failures, if asked for and any

A block is a function of the facts and its attempts alone, so a run that was killed and resumed ends in the same files
as one that never was, and so does one with more workers. The blocks on disk are the manifest: nothing can disagree
with them.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError
from lerobot_demohlm import dataset
from lerobot_demohlm.dataset import Episode, GenerationFacts


def partial_directory(root: Path) -> Path:
    """Return where a run keeps its blocks until it is finished."""
    return root.with_name(root.name + ".partial")


def failures_root(root: Path) -> Path:
    """Return where the failed attempts of a run go, if they are kept."""
    return root.with_name(root.name + "-failures")


def write_block(directory: Path, facts: GenerationFacts, attempts: range, episodes: Sequence[Episode]) -> None:
    """Write the attempts of one block; safe to call from any process, and again for a block that is there.

    Args:
        directory: The run's (``GenerationRun.directory``).
        facts: The run's.
        attempts: Indices of the attempts, as ``pending_blocks`` gave them.
        episodes: One an attempt, in their order, failed ones included.
    """
    if [episode.index for episode in episodes] != list(attempts):
        raise DatasetError(
            f"attempts {[episode.index for episode in episodes]}", f"attempts {list(attempts)}", "give all, in order"
        )
    target = _block_directory(directory, attempts)
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    (temporary / "attempts.jsonl").write_text("".join(json.dumps(episode.record()) + "\n" for episode in episodes))
    from lerobot_demohlm import dataset_files  # takes seconds, and not every process writes

    kept = {"episodes": [episode for episode in episodes if episode.outcome == "success"]}
    if facts.keep_failures:
        kept["failures"] = [e for e in episodes if e.outcome != "success" and len(e.success) > 0]
    for name, chosen in kept.items():
        if chosen:
            dataset_files.write_dataset(temporary / name, "local/block", chosen)
    if target.exists():
        shutil.rmtree(temporary)
    else:
        temporary.rename(target)


def _block_directory(directory: Path, attempts: range) -> Path:
    return directory / "blocks" / f"{attempts.start:07d}"


@dataclass(frozen=True, kw_only=True)
class GenerationRun:
    """A generation run on disk, begun or resumed; see ``dataset.py`` for the order in which it is used."""

    root: Path
    repo_id: str
    facts: GenerationFacts

    @classmethod
    def open(cls, root: Path, repo_id: str, facts: GenerationFacts) -> "GenerationRun":
        """Begin a run, or resume the one that was killed.

        Raises:
            DatasetError: The root exists, or a run with other facts was begun there.
        """
        root = Path(root)
        dataset.require_new_root(root)
        if facts.keep_failures:
            dataset.require_new_root(failures_root(root))
        run = cls(root=root, repo_id=repo_id, facts=facts)
        path = run.directory / "run.json"
        if path.exists():
            begun, now = json.loads(path.read_text()), json.loads(json.dumps(asdict(facts)))
            different = sorted(key for key in begun.keys() | now.keys() if begun.get(key) != now.get(key))
            if different:
                key = different[0]
                raise DatasetError(
                    f"{run.directory}, begun with {key}={begun.get(key)}",
                    f"{key}={now.get(key)}, as asked for now",
                    "resume it with the same arguments, or remove it, or choose another --root",
                )
            for leftover in (run.directory / "blocks").glob(".*"):
                shutil.rmtree(leftover)
        else:
            (run.directory / "blocks").mkdir(parents=True, exist_ok=True)
            temporary = path.with_suffix(".tmp")
            temporary.write_text(json.dumps(asdict(facts), indent=2) + "\n")
            temporary.rename(path)
        return run

    @property
    def directory(self) -> Path:
        """Where the blocks are."""
        return partial_directory(self.root)

    def attempts_of_block(self, block: int) -> range:
        """Return the indices of the attempts of a block."""
        start, size = block * self.facts.block_size, self.facts.block_size
        stop = start + size if self.facts.num_attempts is None else min(start + size, self.facts.num_attempts)
        return range(start, stop)

    def is_done(self, block: int) -> bool:
        """Tell whether a block is on disk."""
        return _block_directory(self.directory, self.attempts_of_block(block)).exists()

    def records(self) -> list[dict[str, Any]]:
        """Return the attempts on disk up to the first block that is missing, cut off where the target is met."""
        records: list[dict[str, Any]] = []
        block = 0
        while not self._met(records) and self.is_done(block):
            records += self._block_records(block)
            block += 1
        return self._cut(records)

    def all_records(self) -> list[dict[str, Any]]:
        """Return every attempt on disk, also behind gaps, in order: what a progress bar counts after a resume."""
        paths = sorted((self.directory / "blocks").glob("[0-9]*/attempts.jsonl"))
        return [json.loads(line) for path in paths for line in path.read_text().splitlines()]

    def pending_blocks(self) -> Iterator[range]:
        """Yield the attempts of blocks that are to be computed, in order, until those on disk meet the target.

        The generator looks at the disk each time it is asked. So a runner that draws the next block when a worker is
        free computes at most as many blocks past a ``num_episodes`` target as it has further workers.
        """
        block = 0
        while not self._met(self.records()):
            attempts = self.attempts_of_block(block)
            if len(attempts) == 0:
                return
            if not self.is_done(block):
                yield attempts
            block += 1

    def finish(self, progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
        """Merge the blocks into the dataset at the root and remove the partial directory.

        Args:
            progress: Called with (blocks merged, blocks in all).

        Returns:
            The content of ``meta/demohlm.json``.

        Raises:
            DatasetError: The target is not met yet, or not one attempt succeeded (the partial directory is kept).
        """
        records = self.records()
        if not self._met(records):
            raise DatasetError(
                f"{len(records)} attempts in a row in {self.directory}", "enough for the target", "resume the run"
            )
        if not any(record["outcome"] == "success" for record in records):
            counts = ", ".join(f"{n} {name}" for name, n in dataset.count_outcomes(records).items() if n)
            raise DatasetError(f"no success in {len(records)} attempts ({counts})", "one or more", "try another region")
        dataset.require_new_root(self.root)
        from lerobot_demohlm import dataset_merge  # takes seconds
        from lerobot_demohlm.dataset_card import write_card

        merged = self.directory / "merged"
        shutil.rmtree(merged, ignore_errors=True)
        merged.mkdir()
        for name in ("episodes", "failures"):
            parts = self._parts(name, records, merged)
            if not parts:
                continue
            dataset_merge.merge(parts, self.repo_id, merged / name, progress if name == "episodes" else None)
            content = dataset.write_facts(merged / name, self.facts, records)
            write_card(merged / name, self.repo_id, content)
        if (merged / "failures").exists():
            (merged / "failures").rename(failures_root(self.root))
        (merged / "episodes").rename(self.root)
        shutil.rmtree(self.directory)
        return dataset.read_facts(self.root)

    def _block_records(self, block: int) -> list[dict[str, Any]]:
        path = _block_directory(self.directory, self.attempts_of_block(block)) / "attempts.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()]

    def _met(self, records: Sequence[dict[str, Any]]) -> bool:
        if self.facts.num_attempts is not None:
            return len(records) >= self.facts.num_attempts
        successes = sum(record["outcome"] == "success" for record in records)
        return successes >= (self.facts.num_episodes or 0)

    def _cut(self, records: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Drop the attempts after the one that met the target."""
        for count in range(len(records) + 1):
            if self._met(records[:count]):
                return records[:count]
        return records

    def _parts(self, name: str, records: Sequence[dict[str, Any]], scratch: Path) -> list[Path]:
        """Return the roots of the blocks' datasets in order, the last one cut off behind the last record."""
        from lerobot_demohlm import dataset_merge

        wanted = {record["attempt"] for record in records}
        parts = []
        for block in range(-(-len(records) // self.facts.block_size)):
            part = _block_directory(self.directory, self.attempts_of_block(block)) / name
            if not part.exists():
                continue
            held = [record for record in self._block_records(block) if _belongs(record, name)]
            kept = sum(record["attempt"] in wanted for record in held)
            if kept == len(held):
                parts.append(part)
            elif kept > 0:
                parts.append(dataset_merge.first_episodes(part, scratch / f"cut-{name}", held[:kept], self.facts))
        return parts


def _belongs(record: dict[str, Any], name: str) -> bool:
    """Tell whether an attempt is in its block's ``episodes`` or ``failures`` dataset."""
    succeeded = record["outcome"] == "success"
    return succeeded if name == "episodes" else not succeeded and record["frames"] > 0
