"""LeRobot's own commands as processes."""

import os
import subprocess
import sys
from pathlib import Path


def run(folder: Path, name: str, *options: str) -> str:
    """Run one of LeRobot's commands; returns what it printed.

    Args:
        folder: Where LeRobot keeps its calibrations.
        name: Of the command.
        options: Its options.

    Raises:
        AssertionError: It failed.
    """
    environment = os.environ | {"HF_LEROBOT_CALIBRATION": str(folder / "calibration")}
    path = Path(sys.executable).with_name(name)
    done = subprocess.run(
        [path, *options], env=environment, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr
