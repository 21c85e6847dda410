"""Processes that must be on time."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

_HURRIES = """
import os
from pathlib import Path
from lerobot_demohlm.hardware.priority import HELPERS, hurry
import gc
allowed = hurry(HELPERS)
print(allowed, os.sched_getscheduler(0) == os.SCHED_FIFO, gc.isenabled(), Path("/proc/self/status").read_text())
"""


def test_a_process_that_hurries_says_whether_it_may(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", _HURRIES], capture_output=True, text=True, check=True, cwd=tmp_path)
    allowed, fifo, collects = done.stdout.split()[:3]
    assert allowed == fifo and collects == "False"
    locked = re.search(r"VmLck:\s+(\d+) kB", done.stdout)
    assert locked is not None
    if os.geteuid() == 0 and _may_lock():
        assert int(locked.group(1)) > 10_000  # all of an interpreter with numpy


def _may_lock() -> bool:
    """Return whether this process holds CAP_IPC_LOCK."""
    held = re.search(r"CapEff:\s+([0-9a-f]+)", Path("/proc/self/status").read_text())
    return held is not None and bool(int(held.group(1), 16) >> 14 & 1)


@pytest.mark.parametrize("priority", [0, 1000])
def test_an_impossible_priority_is_not_allowed(priority: int) -> None:
    code = f"from lerobot_demohlm.hardware.priority import hurry; print(hurry({priority}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
