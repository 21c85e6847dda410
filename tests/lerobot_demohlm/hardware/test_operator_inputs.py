"""Keys and buttons: what stops the robot, and that whatever is lost stops it too."""

import os
import struct
import termios
from pathlib import Path

import pytest

from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.operator_inputs import KEYS, Gamepad, obey_key, terminal_keys
from lerobot_demohlm.hardware.records import Mode
from tests.helpers.robot import until


def event(kind: int, number: int, value: int) -> bytes:
    return struct.pack("<IhBB", 0, value, kind, number)


def test_keys() -> None:
    asked: list[Mode] = []
    stopped: list[str] = []
    ended = [obey_key(key, asked.append, stopped.append) for key in (*KEYS, " ", "\x1b", "z", "", "q")]
    assert asked == [Mode.STAND, Mode.RUN, Mode.HOLD, Mode.DAMP]
    assert stopped == ["key", "key"]
    assert ended == [False] * 8 + [True]


def test_ctrl_s_does_not_stop_the_terminal_while_keys_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with terminal_keys() as next_key:
            assert not termios.tcgetattr(theirs)[0] & termios.IXON
            os.write(ours, b"s")
            assert next_key(5.0) == "s"
        assert termios.tcgetattr(theirs)[0] & termios.IXON
    os.close(ours)


def test_a_shell_that_takes_the_terminal_back_does_not_deafen_the_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-Z and ``fg`` a shell leaves its own mode, in which the space bar waits for Enter."""
    ours, theirs = os.openpty()
    shells = termios.tcgetattr(theirs)
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with terminal_keys() as next_key:
            termios.tcsetattr(theirs, termios.TCSANOW, shells)
            os.write(ours, b" ")
            assert next_key(5.0) == " "
            os.write(ours, b"q")
            assert next_key(5.0) == "q"
    os.close(ours)


def test_a_gamepads_buttons_and_its_loss(tmp_path: Path) -> None:
    """A named pipe stands for the device: the kernel's joystick events are read from either in the same way."""
    path = tmp_path / "js0"
    os.mkfifo(path)
    asked: list[Mode] = []
    stopped: list[str] = []
    device = os.open(path, os.O_RDWR)
    pad = Gamepad(path, asked.append, stopped.append)
    os.write(device, event(0x81, 1, 1) + event(0x01, 0, 1) + event(0x01, 0, 0) + event(0x02, 1, 30000)[:5])
    os.write(device, event(0x02, 1, 30000)[5:] + event(0x01, 7, 1) + event(0x01, 1, 1))
    until(lambda: stopped == ["gamepad"], 10.0)
    assert asked == [Mode.RUN, Mode.STAND], "what is only reported at opening asks for nothing"
    os.close(device)
    until(lambda: stopped == ["gamepad", "gamepad lost"], 10.0)
    pad.close()


def test_a_missing_gamepad_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"no gamepad at .*--gamepad"):
        Gamepad(tmp_path / "js9", print, print)
