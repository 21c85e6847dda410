"""Keys of a terminal and buttons of a gamepad -> what the operator asks for.

Keys: s stands, r runs, h holds, d damps, q ends; the space bar is the e-stop. On a gamepad B or the middle button is
the e-stop, A runs, X holds, start stands. Whatever is lost (a gamepad unplugged, a terminal closed) is an e-stop too.
"""

import os
import select
import struct
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.records import Mode

KEYS = {"s": Mode.STAND, "r": Mode.RUN, "h": Mode.HOLD, "d": Mode.DAMP}
ESTOP_KEYS, END_KEY = (" ", "\x1b"), "q"
PAD_MODES = {0: Mode.RUN, 2: Mode.HOLD, 7: Mode.STAND}
PAD_ESTOP = (1, 8)
_EVENT = struct.Struct("<IhBB")  # time [ms], value, type, number: <linux/joystick.h>
_BUTTON, _INITIAL = 0x01, 0x80

Ask = Callable[[Mode], None]
Stop = Callable[[str], None]


@contextmanager
def terminal_keys() -> Iterator[Callable[[float], str]]:
    """Yield what waits for a key for some seconds and returns it, "" for none.

    The terminal echoes nothing, and Ctrl-S does not stop it: whoever writes to a stopped terminal waits. After Ctrl-Z
    and ``fg`` a shell leaves the terminal in its own mode, in which no key is heard before Enter. So the mode is looked
    at each time.
    """
    if not sys.stdin.isatty():
        yield lambda seconds: _read_key(seconds)
        return
    before = termios.tcgetattr(sys.stdin)

    def next_key(seconds: float) -> str:
        now = termios.tcgetattr(sys.stdin)
        if now[0] & termios.IXON or now[3] & (termios.ICANON | termios.ECHO):
            _hear_each_key()
        return _read_key(seconds)

    try:
        _hear_each_key()
        yield next_key
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _hear_each_key() -> None:
    tty.setcbreak(sys.stdin, termios.TCSANOW)  # at once: a key that waits already may be the e-stop
    now = termios.tcgetattr(sys.stdin)
    now[0] &= ~termios.IXON
    termios.tcsetattr(sys.stdin, termios.TCSANOW, now)


def _read_key(seconds: float) -> str:
    """Return a key; the end of the input is an e-stop."""
    ready, _, _ = select.select([sys.stdin], [], [], seconds)
    if not ready:
        return ""
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace") or ESTOP_KEYS[0]


def obey_key(key: str, ask: Ask, stop: Stop) -> bool:
    """Carry out a key; returns whether the operator wants to end."""
    if key in ESTOP_KEYS:
        stop("key")
    elif key in KEYS:
        ask(KEYS[key])
    return key == END_KEY


class Gamepad:
    """A gamepad of Linux's joystick interface, read by a thread.

    Args:
        path: Of the device, such as /dev/input/js0.
        ask: Called with a mode that a button asks for.
        stop: Called with "gamepad" for an e-stop.

    Raises:
        RobotError: It cannot be opened.
    """

    def __init__(self, path: Path, ask: Ask, stop: Stop) -> None:
        try:
            self._file = os.open(path, os.O_RDONLY)
        except OSError as error:
            raise RobotError(
                f"no gamepad at {path} ({error.strerror})", "a joystick device", "check --gamepad"
            ) from error
        self._ask, self._stop = ask, stop
        self._thread = threading.Thread(target=self._run, name="gamepad", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        content = b""
        while True:
            try:
                more = os.read(self._file, 512)
            except OSError:
                more = b""
            if not more:
                self._stop("gamepad lost")
                return
            content += more
            while len(content) >= _EVENT.size:
                _, value, kind, number = _EVENT.unpack_from(content)
                content = content[_EVENT.size :]
                if kind == _BUTTON and value:  # _INITIAL is set in what is only reported at opening
                    self._pressed(number)

    def _pressed(self, number: int) -> None:
        if number in PAD_ESTOP:
            self._stop("gamepad")
        elif number in PAD_MODES:
            self._ask(PAD_MODES[number])

    def close(self) -> None:
        """Close it."""
        with suppress(OSError):
            os.close(self._file)
