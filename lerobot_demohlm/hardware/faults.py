"""A file of faults -> what goes wrong in a simulated robot, and when: seeded, so that the same file is the same run.

Times count from the moment at which the robot stands free of its gantry. A file is JSON: ``{"seed": 3, "faults":
[{"kind": "loss", "at_s": 2.0, "for_s": 1.0, "size": 0.3}]}``, or a list of these, which starts have by turns.
"""

import heapq
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.robot import g1
from lerobot_demohlm.hardware import remote
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.layout import LowState

MESSAGE_FAULTS = ("loss", "delay", "reorder", "duplicate", "bad_crc")
SENSOR_FAULTS = (
    "frozen_tick", "nan", "hot_motor", "mode_machine", "stuck_encoder", "imu_drift", "remote_estop", "push",
)  # fmt: skip
PROCESS_FAULTS = ("kill", "stop", "full_disk")
KINDS = {
    "loss": "share of states that are lost; 1 for all of them",
    "delay": "time by which states come late [s]",
    "reorder": "share of states that change places with the next one",
    "duplicate": "share of states that come twice",
    "bad_crc": "share of states with a flipped bit",
    "frozen_tick": "the robot's counter stands still",
    "nan": "a joint's position is not a number",
    "hot_motor": "temperature of a motor [Celsius]",
    "mode_machine": "the robot says that it is another",
    "stuck_encoder": "a joint's position stands still",
    "imu_drift": "turn of the attitude [rad/s]",
    "remote_estop": "L2 and B are pressed on the remote",
    "push": "change of the pelvis's velocity to the side [m/s]",
    "pose_dropout": "the camera, or what finds poses in its images, goes blind",
    "kill": "SIGKILL for a process of the deployment",
    "stop": "SIGSTOP for a process of the deployment",
    "full_disk": "the recorder can write no more",
}
"""What can go wrong, and what its size means."""
_SIZES = {"loss": 1.0, "delay": 0.02, "reorder": 0.3, "duplicate": 0.3, "bad_crc": 1.0, "hot_motor": 100.0,
          "imu_drift": 0.3, "push": 0.4}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: One of ``KINDS``.
        at_s: When it begins [s].
        for_s: How long it lasts [s].
        size: See ``KINDS``.
        joint: Of the body, where one joint is meant.
        process: Of the deployment, where one process is meant: control, policy, pose, servos, recorder or operator.
    """

    kind: str
    at_s: float
    for_s: float = 1e9
    size: float | None = None
    joint: str = "left_knee"
    process: str = "policy"

    def __post_init__(self) -> None:
        """Check kind and joint.

        Raises:
            UnknownNameError: There is no such kind, joint or process.
        """
        if self.kind not in KINDS:
            raise UnknownNameError("fault", self.kind, KINDS)
        if self.joint not in g1.BODY_JOINTS:
            raise UnknownNameError("joint", self.joint, g1.BODY_JOINTS)
        if self.process not in PROCESSES:
            raise UnknownNameError("process", self.process, PROCESSES)

    @property
    def amount(self) -> float:
        """Its size, or the usual one of its kind."""
        return _SIZES.get(self.kind, 1.0) if self.size is None else self.size

    @property
    def index(self) -> int:
        """Of its joint among ``g1.BODY_JOINTS``."""
        return g1.BODY_JOINTS.index(self.joint)

    def active(self, time_s: float) -> bool:
        """Return whether it is there at a time [s]."""
        return self.at_s <= time_s < self.at_s + self.for_s


PROCESSES = ("control", "policy", "pose", "servos", "recorder", "operator")


@dataclass(frozen=True, kw_only=True)
class Faults:
    """All that goes wrong in a start.

    Attributes:
        seed: Of what is random about it.
        faults: Each.
    """

    seed: int = 0
    faults: tuple[Fault, ...] = ()

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "Faults":
        """Return the faults of a file's content.

        Raises:
            RobotError: It is something else.
        """
        try:
            return cls(seed=int(content.get("seed", 0)), faults=tuple(Fault(**entry) for entry in content["faults"]))
        except (TypeError, KeyError, AttributeError, ValueError) as error:
            raise RobotError(f"faults that cannot be read ({error})", '{"seed": 0, "faults": [{"kind": "loss", '
                             '"at_s": 2.0}]}', f"kinds are {', '.join(KINDS)}") from error  # fmt: skip

    @classmethod
    def read(cls, path: Path | None) -> tuple["Faults", ...]:
        """Return the faults of a file, which starts have by turns; none without one.

        Raises:
            RobotError: There is no such file, or it holds something else.
        """
        if path is None:
            return (cls(),)
        try:
            content = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise RobotError(f"no faults in {path} ({error})", "a JSON file", "check --faults") from error
        if content == []:
            raise RobotError(f"an empty list in {path}", "the faults of one start or more", "check --faults")
        return tuple(cls.of(entry) for entry in (content if isinstance(content, list) else [content]))

    def now(self, time_s: float, *kinds: str) -> list[Fault]:
        """Return what is wrong at a time [s], of some kinds."""
        return [fault for fault in self.faults if fault.kind in kinds and fault.active(time_s)]


class FaultySensors:
    """Spoils what the robot measures.

    Args:
        faults: What goes wrong.
    """

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._kept: dict[int, float] = {}
        self._drift = 0.0
        self._tick: int | None = None

    def spoil(self, state: LowState, time_s: float, dt: float) -> None:
        """Change a message before it is sealed, in place.

        Args:
            state: What was measured.
            time_s: Since the robot stands free [s].
            dt: Since the message before [s].
        """
        frozen = False
        for fault in self._faults.now(time_s, *SENSOR_FAULTS):
            index = fault.index
            if fault.kind == "frozen_tick":
                self._tick = state.tick if self._tick is None else self._tick
                state.tick, frozen = self._tick, True
            elif fault.kind == "nan":
                state.q[index] = np.nan
            elif fault.kind == "hot_motor":
                state.temperature[index] = int(fault.amount)
            elif fault.kind == "mode_machine":
                state.mode_machine = state.mode_machine + 1
            elif fault.kind == "stuck_encoder":
                state.q[index] = self._kept.setdefault(index, float(state.q[index]))
            elif fault.kind == "remote_estop":
                remote.press(state.remote, frozenset({"L2", "B"}))
            elif fault.kind == "imu_drift":
                self._drift += dt * fault.amount
        if not frozen:
            self._tick = None
        if self._drift:
            half = 0.5 * self._drift
            w, x, y, z = state.quat_wxyz.astype(np.float64)
            cos, sin = np.cos(half), np.sin(half)
            state.quat_wxyz[:] = w * cos - x * sin, x * cos + w * sin, y * cos + z * sin, z * cos - y * sin


class FaultyLine:
    """Loses, delays, exchanges, doubles and damages messages on their way.

    Args:
        faults: What goes wrong.
    """

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._rng = np.random.default_rng([28, faults.seed])
        self._late: list[tuple[float, int, bytes]] = []
        self._number = 0
        self._held: bytes | None = None

    def carry(self, content: bytes, time_s: float) -> list[bytes]:
        """Return what arrives now, when a message is sent at a time [s] since the robot stands free."""
        arriving, delay = [content], 0.0
        for fault in self._faults.now(time_s, *MESSAGE_FAULTS):
            if fault.kind == "delay":
                delay = fault.amount
                continue
            if self._rng.random() >= fault.amount:
                continue
            if fault.kind == "loss":
                arriving = []
            elif fault.kind == "duplicate":
                arriving = arriving * 2
            elif fault.kind == "bad_crc":
                arriving = [_flipped(message, self._rng) for message in arriving]
            elif fault.kind == "reorder" and self._held is None and arriving:
                self._held = arriving.pop()
        if self._held is not None and arriving:
            arriving.append(self._held)
            self._held = None
        for message in arriving:
            self._number += 1
            heapq.heappush(self._late, (time_s + delay, self._number, message))
        found = []
        while self._late and self._late[0][0] <= time_s:
            found.append(heapq.heappop(self._late)[2])
        return found


def _flipped(message: bytes, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(8 * 16, 8 * (len(message) - 4)))
    damaged = bytearray(message)
    damaged[place // 8] ^= 1 << place % 8
    return bytes(damaged)
