"""One controller a robot on this machine: a lock that the system opens when its process ends, in any way."""

import fcntl
import os
import tempfile
from pathlib import Path

from lerobot_demohlm.hardware.errors import RobotError


class ControllerLock:
    """Held while this process controls the robot on an interface.

    Args:
        interface: Of the network.
        domain: Of DDS.

    Raises:
        RobotError: Another process of this machine holds it.
    """

    def __init__(self, interface: str, domain: int) -> None:
        path = Path(tempfile.gettempdir()) / f"demohlm-{os.getuid()}-{interface}-{domain}.lock"
        self._file = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.seek(0)
            holder = self._file.read().strip()
            self._file.close()
            raise RobotError(
                f"a controller on {interface} already, process {holder or 'unknown'}", "one controller", "stop it first"
            ) from None
        self._file.truncate(0)
        self._file.write(str(os.getpid()))
        self._file.flush()

    def release(self) -> None:
        """Open the lock."""
        self._file.close()
