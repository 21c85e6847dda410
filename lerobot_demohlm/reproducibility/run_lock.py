"""A directory -> a lock on it that one process holds, and that the system opens when that process ends, in any way."""

import fcntl
import os
import platform
from pathlib import Path

from gym_demohlm.errors import DatasetError


class RunLock:
    """Holds a run's directory for this process; what is left on disk of a process that was killed locks nothing.

    Args:
        directory: Must exist.

    Raises:
        DatasetError: Another process holds it.
    """

    def __init__(self, directory: Path) -> None:
        path = directory / "lock"
        self._file = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not path.exists() or path.stat().st_ino != os.fstat(self._file.fileno()).st_ino:
                raise BlockingIOError  # of a run that ended, and removed it, in this very moment
        except BlockingIOError:
            self._file.seek(0)
            holder = self._file.read().strip() or "another process"
            self._file.close()
            raise DatasetError(
                f"{directory}, at which {holder} is at work",
                "one run at a time on one root",
                "wait until it has ended, or choose another --root",
            ) from None
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {platform.node()}\n")
        self._file.flush()

    def release(self) -> None:
        """Open the lock."""
        self._file.close()
