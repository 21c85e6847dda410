"""Attempts of one block <-> a directory that appears by one rename and can tell whether it is still whole.

On disk, in the directory of a run::

    blocks/0000016/              attempts 16 to 23
        block.json               which attempts, a digest of the run's facts, and the SHA-256 of every other file
        attempts.jsonl           one line an attempt
        episodes/                LeRobot dataset of the successes, if any
        failures/                LeRobot dataset of the failures, if asked for and any

A block is a function of the facts and its attempts alone, whichever process of whichever machine makes it.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import GenerationFacts, read_records

if TYPE_CHECKING:
    from lerobot_demohlm.datasets.pictures import DrawnBlock

MANIFEST = "block.json"
RECORDS = "attempts.jsonl"


@contextlib.contextmanager
def storing(path: Path) -> Iterator[None]:
    """Turn what the system says against writing (disk full, read-only, no permission) into a ``DatasetError``."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"{error.strerror or error} at {path}",
            "a place with room that may be written",
            "free space, or choose another --root; blocks that are finished are kept, and the same command goes on",
        ) from error


def block_directory(directory: Path, attempts: range) -> Path:
    """Return where the block of these attempts is in a run's directory."""
    return directory / "blocks" / f"{attempts.start:07d}"


def write_block(
    directory: Path,
    facts: GenerationFacts,
    attempts: range,
    episodes: Sequence[Episode],
    drawn: "DrawnBlock | None" = None,
) -> None:
    """Write the attempts of one block; safe to call from any process, and again for a block that is there.

    Args:
        directory: The run's (``GenerationRun.directory``).
        facts: The run's.
        attempts: Indices of the attempts, as ``pending_blocks`` gave them.
        episodes: One an attempt, in their order, failed ones included.
        drawn: Pictures of the successful ones.
    """
    if [episode.index for episode in episodes] != list(attempts):
        raise DatasetError(
            f"attempts {[episode.index for episode in episodes]}", f"attempts {list(attempts)}", "give all, in order"
        )
    with _appearing(directory, attempts) as temporary:
        jsonl.write(temporary / RECORDS, [episode.record() for episode in episodes])
        kept = {"episodes": [episode for episode in episodes if episode.outcome == "success"]}
        if facts.keep_failures:
            kept["failures"] = [e for e in episodes if e.outcome != "success" and len(e.success) > 0]
        for name, chosen in kept.items():
            if chosen:
                from lerobot_demohlm.datasets import writer  # takes seconds, and not every process writes

                pictures = drawn if name == "episodes" else None
                writer.write_dataset(temporary / name, "local/block", chosen, facts, pictures)
        (temporary / MANIFEST).write_text(json.dumps(_manifest(temporary, facts, attempts), indent=2) + "\n")


def pack_block(directory: Path, attempts: range) -> dict[str, bytes]:
    """Return the files of a block by their names, to be sent to where the run is."""
    block = block_directory(directory, attempts)
    return {name: (block / name).read_bytes() for name in [MANIFEST, *_files(block)]}


def unpack_block(directory: Path, attempts: range, files: Mapping[str, bytes]) -> None:
    """Write the files of a block that ``pack_block`` returned elsewhere.

    Raises:
        DatasetError: A name leads out of the block, or the disk refuses them.
    """
    with _appearing(directory, attempts) as temporary:
        for name, content in files.items():
            path = PurePosixPath(name)
            if path.is_absolute() or ".." in path.parts:
                raise DatasetError(f"a file {name!r} in a block", "a name inside of it", "do not trust its sender")
            (temporary / path).parent.mkdir(parents=True, exist_ok=True)
            (temporary / path).write_bytes(content)


def read_block(directory: Path, facts: GenerationFacts, attempts: range) -> list[dict[str, Any]]:
    """Return the records of a block's attempts, every file of it compared with its checksum.

    Raises:
        DatasetError: It is not the block that was written, whole and of these facts.
    """
    block = block_directory(directory, attempts)
    try:
        written = json.loads((block / MANIFEST).read_bytes())
        found = _manifest(block, facts, attempts)
    except (OSError, ValueError, RecursionError) as error:
        raise _damaged(block, str(error)) from error
    if written != found:
        before, now = (entry.get("files", {}) if isinstance(entry, dict) else {} for entry in (written, found))
        if not isinstance(before, dict):
            raise _damaged(block, MANIFEST)
        changed = sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))
        raise _damaged(block, ", ".join(changed) if changed else "made by another run")
    records = read_records(block / RECORDS)
    if [record["attempt"] for record in records] != list(attempts):
        raise _damaged(block, RECORDS)
    return records


def _damaged(block: Path, what: str) -> DatasetError:
    return DatasetError(
        f"the block {block}, damaged ({what})", "the files as written", "the same command makes it again"
    )


def _files(block: Path) -> list[str]:
    """Return the names of a block's files, all but the manifest, in order."""
    names = (path.relative_to(block).as_posix() for path in block.rglob("*") if not path.is_dir())
    return sorted(name for name in names if name != MANIFEST)


def _manifest(block: Path, facts: GenerationFacts, attempts: range) -> dict[str, Any]:
    """Return what ``block.json`` says of the files that are there."""
    of_run = hashlib.sha256(json.dumps(facts.content(), sort_keys=True).encode()).hexdigest()
    files = {}
    for name in _files(block):
        with (block / name).open("rb") as file:
            files[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return {"attempts": [attempts.start, attempts.stop], "facts": of_run, "files": files}


@contextlib.contextmanager
def _appearing(directory: Path, attempts: range) -> Iterator[Path]:
    """Give a temporary directory that becomes the block by one rename; nothing of it stays where that fails."""
    target = block_directory(directory, attempts)
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with storing(directory):
            temporary.mkdir()  # without parents: a run that has ended is not begun again by a worker that was late
            yield temporary
            try:
                temporary.rename(target)
            except OSError:
                if not target.exists():  # or another process, of a run that was killed, has just made the same
                    raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
