"""The newest value of one process, with its age, for all others: shared memory in place of queues.

A slot has one writer and any number of readers, and nobody waits. The writer fills the half that nobody is told to
read, then says so; a checksum tells a reader who was overtaken to look again. A writer that is killed at any moment
leaves the last whole value, which grows old. Ages are told by ``time.monotonic_ns``, one clock for all processes.
"""

import mmap
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_demohlm.hardware.errors import RobotError

_HEAD = np.dtype([("number", "<u8"), ("time_ns", "<i8"), ("crc", "<u4"), ("_", "<u4")])
_TRIES = 100


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What a slot held.

    Attributes:
        value: A record of the slot's type, a copy.
        number: How many values had been written.
        time_ns: When the value was measured (``time.monotonic_ns``).
    """

    value: np.void
    number: int
    time_ns: int

    @property
    def age_s(self) -> float:
        """Time since it was measured [s]."""
        return 1e-9 * (time.monotonic_ns() - self.time_ns)


class Slot:
    """One value in a file that processes map into their memory.

    Args:
        path: The file; made where it does not exist.
        dtype: Of the record that it holds.

    Raises:
        RobotError: The file holds a record of another size.
    """

    def __init__(self, path: Path, dtype: np.dtype) -> None:
        self.path, self.dtype = path, dtype
        size = 8 + 2 * (_HEAD.itemsize + dtype.itemsize)
        with path.open("a+b") as file:
            found = path.stat().st_size
            if found == 0:
                file.truncate(size)
            elif found != size:
                raise RobotError(f"{path.name} of {found} bytes", f"{size}", "start all processes of one version")
            self._map = mmap.mmap(file.fileno(), size)
        self._count = np.frombuffer(self._map, "<u8", 1)
        half_size = _HEAD.itemsize + dtype.itemsize
        halves = [np.frombuffer(self._map, np.uint8, half_size, 8 + half * half_size) for half in (0, 1)]
        self._heads = [half[: _HEAD.itemsize].view(_HEAD) for half in halves]
        self._values = [half[_HEAD.itemsize :] for half in halves]

    def write(self, value: np.ndarray | np.void, time_ns: int | None = None) -> None:
        """Make a record the newest.

        Args:
            value: Of the slot's type.
            time_ns: When it was measured; now by default.
        """
        content = np.asarray(value, self.dtype).tobytes()
        number = int(self._count[0]) + 1
        head, half = self._heads[number % 2][0], self._values[number % 2]
        head["number"] = 0
        half[:] = np.frombuffer(content, np.uint8)
        stamp = time.monotonic_ns() if time_ns is None else time_ns
        head["time_ns"], head["crc"] = stamp, _checksum(content, stamp)
        head["number"] = number
        self._count[0] = number

    def read(self) -> Reading | None:
        """Return the newest record; None where none has been written, or none can be read whole."""
        for _ in range(_TRIES):
            number = int(self._count[0])
            if number == 0:
                return None
            head = self._heads[number % 2][0].copy()
            content = self._values[number % 2].tobytes()
            if int(head["number"]) == number and _checksum(content, int(head["time_ns"])) == int(head["crc"]):
                value = np.frombuffer(content, self.dtype)[0]
                return Reading(value=value, number=number, time_ns=int(head["time_ns"]))
        return None

    def age_s(self) -> float:
        """Return the age of the newest record [s]; infinite where there is none."""
        reading = self.read()
        return np.inf if reading is None else reading.age_s


def _checksum(content: bytes, time_ns: int) -> int:
    return zlib.crc32(content, time_ns & 0xFFFFFFFF)
