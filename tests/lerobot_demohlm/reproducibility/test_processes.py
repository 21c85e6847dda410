"""Worker processes end when the one that started them does."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

CODE = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from lerobot_demohlm.processes import end_with_parent

def take_long(path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)

if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, multiprocessing.get_context(sys.argv[1]), end_with_parent)
    pool.submit(take_long, sys.argv[2]).result()
"""


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_a_worker_ends_with_a_killed_parent(method: str, tmp_path: Path) -> None:
    script, file = tmp_path / "script.py", tmp_path / "pid"
    script.write_text(CODE)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, script, method, file], env=environment)
    deadline = time.monotonic() + 60
    while not (file.exists() and file.read_text()):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.kill()
    process.wait()
    killed = time.monotonic()
    while Path(f"/proc/{file.read_text()}").exists():
        assert time.monotonic() < killed + 10  # it would sleep for a minute
        time.sleep(0.05)
