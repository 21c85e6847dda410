"""The control process without a robot: what ends it, sleep that the machine itself slept, and where the neck turns."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from lerobot_demohlm.hardware import control_process, records
from lerobot_demohlm.hardware.control_process import FAREWELL, ControlProcess
from lerobot_demohlm.hardware.following import NeckFollower, Search
from lerobot_demohlm.hardware.limits import Ages
from lerobot_demohlm.hardware.odometry import odometry_camera
from lerobot_demohlm.hardware.records import Mode
from tests.helpers.robot import until

_DEPLOYMENT = """
import fcntl, multiprocessing, os, signal, sys, termios, time
from pathlib import Path
from types import SimpleNamespace
from lerobot_demohlm.hardware import processes
from lerobot_demohlm.hardware.control_process import ControlProcess
from lerobot_demohlm.hardware.records import Mode

folder = Path(sys.argv[1])
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGQUIT):  # tests in the background may have been started with these ignored
    signal.signal(number, signal.SIG_DFL)
if os.isatty(0):
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)

class Control(ControlProcess):  # without network, robot and controller
    _machine_mode = 5
    def __init__(self):
        self._stop, self._late, self._wire, self._machine = False, 0, self, SimpleNamespace(mode=Mode.RUN)
    def _look(self):
        return False
    def _tick(self):
        (folder / "pid").write_text(str(os.getpid()))
    def damp(self, mode):
        with (folder / "braked").open("a") as file:
            file.write("x")

processes._make = lambda *_: Control()
child = multiprocessing.get_context("fork").Process(target=processes.run_process, args=("control", None, folder))
child.start()
try:
    time.sleep(600.0)
except KeyboardInterrupt:
    child.terminate()
    child.join()
"""


def started(folder: Path, terminal: int) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", _DEPLOYMENT, str(folder)], stdin=terminal, stdout=terminal, stderr=terminal,
        start_new_session=True,
    )  # fmt: skip


def hang_up(terminal: int, parent: int) -> None:
    os.close(terminal)


def press(key: bytes) -> Callable[[int, int], None]:
    def end(terminal: int, parent: int) -> None:
        os.write(terminal, key)

    return end


@pytest.mark.parametrize("end", [
    hang_up, press(b"\x03"), press(b"\x1c"), lambda terminal, parent: os.kill(parent, signal.SIGKILL),
], ids=["hang up", "Ctrl-C", "Ctrl-backslash", "killed"])  # fmt: skip
def test_however_its_terminal_or_its_parent_ends_it_brakes(end: Callable[[int, int], None], tmp_path: Path) -> None:
    terminal, theirs = os.openpty()
    parent = started(tmp_path, theirs)
    os.close(theirs)
    until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text() != "", 60.0)
    assert os.getpgid(int((tmp_path / "pid").read_text())) != os.getpgid(parent.pid), "it is stopped by Ctrl-Z"
    assert not (tmp_path / "braked").exists()
    end(terminal, parent.pid)
    until(lambda: (tmp_path / "braked").exists() and len((tmp_path / "braked").read_text()) == FAREWELL, 30.0)
    parent.wait()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT])
def test_whatever_signal_asks_for_its_end_it_brakes(number: signal.Signals, tmp_path: Path) -> None:
    parent = started(tmp_path, subprocess.DEVNULL)
    try:
        until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text() != "", 60.0)
        os.kill(int((tmp_path / "pid").read_text()), number)
        until(lambda: (tmp_path / "braked").exists() and len((tmp_path / "braked").read_text()) == FAREWELL, 30.0)
    finally:
        parent.kill()
        parent.wait()


def test_a_machine_that_was_suspended_has_slept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linux's monotonic clock stands still then; the clock since boot goes on."""
    suspended_s, slept = 0.0, []

    def clock(which: int) -> int:
        return time.monotonic_ns() + round(1e9 * suspended_s) * (which == time.CLOCK_BOOTTIME)

    monkeypatch.setattr(control_process.time, "clock_gettime_ns", clock)
    process: Any = ControlProcess.__new__(ControlProcess)
    process._looked_ns = clock(time.CLOCK_BOOTTIME)
    process._states = SimpleNamespace(take=list)
    process._machine = SimpleNamespace(mode=Mode.RUN, update=lambda *_: False)
    process._watch = process._sent_q = None
    process._request = lambda: None
    process._observe = slept.append
    process._look()
    suspended_s = 3600.0
    process._look()
    assert slept[0] < 3600.0 < slept[1]


class Necks:
    """The neck of a robot that does StackCube: its target is the red cube, and it sees the blue one all the time."""

    def __init__(self, folder: Path) -> None:
        task = get_task("StackCube")
        self._process: Any = ControlProcess.__new__(ControlProcess)
        self._process._slots = {name: records.slot(folder, name) for name in records.RECORDS}
        self._process._settings, self._process._seen = (
            SimpleNamespace(ages=Ages()),
            SimpleNamespace(pose=0.02, policy=0.05),
        )
        self._process._gaze = [entry.name for entry in task.objects].index(task.gaze_target)
        self._process._search, self._process._neck = Search(task), NeckFollower()
        self._neck = np.zeros(2)

    def turn(self, torso_yaw: float, red_age_s: float) -> np.ndarray:
        """Have the torso stand at a yaw [rad] for a tick, the red cube seen that long ago; returns the neck's goals."""
        slots = self._process._slots
        state = records.record(
            "state", T_odometry_torso=poses.planar(0.0, 0.0, torso_yaw) @ poses.pose([0.0, 0.0, 1.0])
        )
        servos = records.record("servos", neck=self._neck)
        slots["state"].write(state)
        slots["servos"].write(servos)
        T_camera_odometry = poses.invert(odometry_camera(state, servos))
        T = np.tile(np.eye(4), (records.MAX_OBJECTS, 1, 1))
        T[0], T[1] = (T_camera_odometry @ poses.pose([1.0, y, 1.0]) for y in (0.0, 0.2))
        seen = {"valid": [red_age_s == 0.0, True, False, False], "age_s": [red_age_s, 0.0, 0.0, 0.0]}
        there = poses.invert(T_camera_odometry)
        slots["pose"].write(records.record("pose", T_camera_object=T, T_odometry_camera=there, **seen))
        self._process._send_servos(command.rest())
        self._neck = slots["servo_goals"].read().value["neck"].copy()
        return self._neck


@pytest.mark.parametrize("red_age_s", [0.0, 3.0])
def test_a_neck_turns_to_where_its_target_is_or_was_as_in_training(red_age_s: float, tmp_path: Path) -> None:
    necks = Necks(tmp_path)
    for _ in range(100):
        necks.turn(0.0, 0.0)
    for tick in range(200):
        goals = necks.turn(-0.8 * min(1.0, tick / 75), red_age_s)
    assert goals[0] == pytest.approx(0.8, abs=0.1)


def test_a_neck_searches_for_a_target_that_was_never_seen_while_it_sees_others(tmp_path: Path) -> None:
    necks = Necks(tmp_path)
    yaws = [necks.turn(0.0, np.inf)[0] for _ in range(600)]
    assert max(yaws) > 1.0 and min(yaws) < -1.0
