"""DDS domains and waiting, for tests of the way to the robot."""

import os
import time
from collections.abc import Callable

_made = 0


def free_domain() -> int:
    """Return a DDS domain that no other test of this process, and no other test process, is likely to use."""
    global _made
    _made += 1
    return 20 + (17 * os.getpid() + _made) % 200


def until(condition: Callable[[], bool], timeout_s: float, pause_s: float = 0.005) -> None:
    """Wait until a condition holds.

    Raises:
        AssertionError: It does not within the time.
    """
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"{condition} did not come true within {timeout_s} s"
        time.sleep(pause_s)
