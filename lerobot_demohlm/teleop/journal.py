"""A recording under way <-> a directory from which it can be taken up again after the process was killed.

On disk: ``start.npz`` (the world and the command before the first row), ``start.json`` (task, hashes, who and where),
and ``rows.bin``, one record of fixed size a step: the command, and the poses that were asked for. All else that a
demonstration holds follows from these bit for bit. A record that was only half written is left out. Each record is
handed to the system at once, which keeps it when the process is killed; waiting for the disk would hold up the world.
"""

import contextlib
import itertools
import json
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.errors import DemonstrationError

_ROW = np.dtype([("action", "<f4", (command.SIZE,)), ("hands", "<f8", (2, 7)), ("head", "<f8", (4, 4))])


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """A recording that was not finished.

    Attributes:
        start: The world before its first row.
        last: (23,) the command before its first row.
        facts: What ``Journal.begin`` was given.
        actions: (T, 23) float32.
        hand_targets: (T, 2, 7) position and quaternion wxyz.
        head_targets: (T, 4, 4); NaN where the head had none.
    """

    start: dict[str, np.ndarray]
    last: np.ndarray
    facts: dict[str, Any]
    actions: np.ndarray
    hand_targets: np.ndarray
    head_targets: np.ndarray


class Journal:
    """Keeps a recording on disk while it is made.

    Args:
        directory: Where; it is made when a recording begins, and removed by ``remove``.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory)
        self._file: BinaryIO | None = None

    def begin(self, start: dict[str, np.ndarray], last: np.ndarray, facts: dict[str, Any]) -> None:
        """Begin anew.

        Args:
            start: The world before the first row.
            last: (23,) the command before it.
            facts: Whatever JSON can hold.
        """
        self.remove()
        self.directory.mkdir(parents=True)
        np.savez(self.directory / "start.npz", allow_pickle=False, last=last, **{f"s.{k}": v for k, v in start.items()})
        (self.directory / "start.json").write_text(json.dumps(facts, indent=2) + "\n")
        self._file = (self.directory / "rows.bin").open("wb")

    def append(self, action: np.ndarray, hand_targets: np.ndarray, head_target: np.ndarray | None) -> None:
        """Add a row: action (23,), targets (2, 7) of the palms, and (4, 4) of the head or None.

        Raises:
            OSError: It cannot be written now; it is written before the next row.
        """
        if self._file is None:
            return
        row = np.zeros((), dtype=_ROW)
        row["action"], row["hands"] = action, hand_targets
        row["head"] = np.nan if head_target is None else head_target
        self._file.write(row.tobytes())
        self._file.flush()

    def cut(self, rows: int) -> None:
        """Keep the first ``rows`` rows and drop the others."""
        if self._file is not None:
            self._file.truncate(rows * _ROW.itemsize)
            self._file.seek(rows * _ROW.itemsize)

    def close(self) -> None:
        """Close the file; the journal stays on disk, with all that could be written."""
        if self._file is not None:
            with contextlib.suppress(OSError):  # a full disk was told of before
                self._file.close()
            self._file = None

    def remove(self) -> None:
        """Close the journal and delete its folder."""
        self.close()
        shutil.rmtree(self.directory, ignore_errors=True)

    def set_aside(self) -> Path:
        """Rename the folder, so that no recording replaces it; returns where it is now."""
        others = (self.directory.with_name(f"{self.directory.name}.{number}") for number in itertools.count(1))
        return self.directory.rename(next(path for path in others if not path.exists()))

    def reopen(self, rows: int) -> None:
        """Go on with the one on disk, behind so many rows."""
        self._file = (self.directory / "rows.bin").open("r+b")
        self.cut(rows)

    def find(self) -> Found | None:
        """Return the recording on disk; None where there is none, or not one row.

        Raises:
            DemonstrationError: It cannot be read.
        """
        if not (self.directory / "rows.bin").exists():
            return None
        try:
            with np.load(self.directory / "start.npz", allow_pickle=False) as arrays:
                contents = {name: arrays[name] for name in arrays.files}
            last = contents["last"]
            facts = json.loads((self.directory / "start.json").read_text())
            if not isinstance(facts, dict) or "start" not in facts:
                raise ValueError("start.json has no start")
            content = (self.directory / "rows.bin").read_bytes()
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile) as error:
            raise DemonstrationError(
                f"{self.directory}, damaged ({error})", "an unfinished recording", "remove it"
            ) from error
        rows = np.frombuffer(content[: len(content) // _ROW.itemsize * _ROW.itemsize], dtype=_ROW)
        if len(rows) == 0:
            return None
        return Found(
            start={name.removeprefix("s."): array for name, array in contents.items() if name.startswith("s.")},
            last=last,
            facts=facts,
            actions=rows["action"].copy(),
            hand_targets=rows["hands"].copy(),
            head_targets=rows["head"].copy(),
        )
