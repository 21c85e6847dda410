"""What worker processes of tests do with a block: little, and where asked for, they die of it."""

import os
import signal
import time
from pathlib import Path

from gym_demohlm.errors import DatasetError


def write(directory: Path, attempts: range) -> None:
    """Make the block's directory."""
    (directory / "blocks" / f"{attempts.start:07d}").mkdir()


def die_once(directory: Path, attempts: range) -> None:
    """Die at the first try of each block."""
    tried = directory / f"tried-{attempts.start}"
    if not tried.exists():
        tried.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    write(directory, attempts)


def fail(directory: Path, attempts: range) -> None:
    """Raise an error with a remedy."""
    raise DatasetError(f"attempts {attempts.start}", "others", f"leave {directory.name} alone")


def stumble(directory: Path, attempts: range) -> None:
    """Raise an error that nobody has foreseen."""
    raise ZeroDivisionError(f"{directory.name} {attempts.start}")


def take_long(directory: Path, attempts: range) -> None:
    """Say who is at work and go on for a minute."""
    (directory / f"pid-{attempts.start}").write_text(str(os.getpid()))
    time.sleep(60.0)
