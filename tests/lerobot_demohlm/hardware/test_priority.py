"""Processes that must be on time."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

_HURRIES = """
import gc, os, sys
from pathlib import Path
from lerobot_demohlm.hardware.priority import Urgency, hurry
allowed = hurry(Urgency[sys.argv[1]])
print(allowed, os.sched_getscheduler(0) == os.SCHED_FIFO, os.getpriority(os.PRIO_PROCESS, 0), gc.isenabled())
print(Path("/proc/self/status").read_text())
"""


@pytest.mark.parametrize("urgency", ["CONTROL", "HELPER"])
def test_a_process_that_hurries_says_whether_it_may(urgency: str, tmp_path: Path) -> None:
    code = [sys.executable, "-c", _HURRIES, urgency]
    done = subprocess.run(code, capture_output=True, text=True, check=True, cwd=tmp_path)
    allowed, real_time, niceness, collects = done.stdout.split()[:4]
    if urgency == "CONTROL":
        assert allowed == real_time
    else:  # real-time helpers that fill a core would have Linux stop control too
        assert real_time == "False" and (allowed == "True") == (niceness == "-15")
    assert collects == "False"
    locked = re.search(r"VmLck:\s+(\d+) kB", done.stdout)
    assert locked is not None
    if os.geteuid() == 0 and _may_lock():
        assert int(locked.group(1)) > 10_000  # all of an interpreter with numpy


def _may_lock() -> bool:
    """Return whether this process holds CAP_IPC_LOCK."""
    held = re.search(r"CapEff:\s+([0-9a-f]+)", Path("/proc/self/status").read_text())
    return held is not None and bool(int(held.group(1), 16) >> 14 & 1)
