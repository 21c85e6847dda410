"""Messages of a page <-> controls and buttons: everything that comes from outside is checked here.

Poses of devices come in WebXR's axes, x to the right, y up, z backwards, as seven numbers: position [m] and quaternion
wxyz. They leave in the robot's axes, x forward, y left, z up. ``docs/teleoperation.md`` describes every message.
"""

import json
import math
import struct
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.teleop.clutch import Controls, HandControls
from lerobot_demohlm.teleop.status import Status

VERSION = 1
MAX_MESSAGE = 16_384  # bytes
MAX_COORDINATE = 100.0  # m
MAX_HEADING = 4.0 * math.pi  # rad
BUTTONS = ("record", "rewind", "save", "discard", "recover")
DEVICES = ("headset", "hands", "phone", "gamepad", "keyboard", "script", "other")
_R_robot_room = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_FRAME_HEADER = struct.Struct("<dII")  # server's time [s], steps recorded, number of bodies


class ProtocolError(DemoHLMError):
    """A message that is refused."""


@dataclass(frozen=True, kw_only=True)
class Input:
    """What an operator's page says some thirty to ninety times a second.

    Attributes:
        controls: Hands, head, sticks.
        sequence: Number of the message.
        sent_s: When it was sent, by the server's clock as the page estimates it [s].
        device: Kind of device.
    """

    controls: Controls
    sequence: int
    sent_s: float
    device: str


@dataclass(frozen=True, kw_only=True)
class Press:
    """A button.

    Attributes:
        button: One of ``BUTTONS``.
    """

    button: str


@dataclass(frozen=True, kw_only=True)
class Ping:
    """A question for the server's time.

    Attributes:
        time: The page's, sent back with the answer.
    """

    time: float


@dataclass(frozen=True, kw_only=True)
class Invite:
    """A request for the address of one more operator's browser."""


Message = Input | Press | Ping | Invite


def parse(text: str) -> Message:
    """Return what a message says.

    Raises:
        ProtocolError: It is not one that is documented.
    """
    if len(text) > MAX_MESSAGE:
        raise ProtocolError(f"a message of {len(text)} characters", f"at most {MAX_MESSAGE}", "send less")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _refused(f"no JSON ({error})") from None
    if not isinstance(content, dict):
        raise _refused(f"a message that is a {type(content).__name__}")
    kind = content.get("type")
    if kind == "input":
        return _input(content)
    if kind == "press":
        return Press(button=_one_of("button", content.get("button"), BUTTONS))
    if kind == "ping":
        return Ping(time=_number("t", content.get("t")))
    if kind == "invite":
        return Invite()
    raise _refused(f"a message of type {str(kind)[:40]!r}")


def _input(content: dict[str, Any]) -> Input:
    hands = content.get("hands", {})
    if not isinstance(hands, dict) or not set(hands) <= {"left", "right"}:
        raise _refused("hands that are not left and right")
    head, heading = content.get("head"), content.get("heading")
    sequence = content.get("seq", 0)
    if type(sequence) is not int or not 0 <= sequence < 2**53:
        raise _refused("a seq that is no whole number")
    return Input(
        controls=Controls(
            left=_hand(hands.get("left", {})),
            right=_hand(hands.get("right", {})),
            head=None if head is None else _pose("head", head),
            lean=_flag("lean", content.get("lean", True)),
            heading=None if heading is None else _number("heading", heading, MAX_HEADING),
            walk=_numbers("walk", content.get("walk", [0, 0, 0]), 3, 1.0),
            lift=_number("lift", content.get("lift", 0), 1.0),
        ),
        sequence=sequence,
        sent_s=_number("t", content.get("t", 0.0)),
        device=_one_of("device", content.get("device", "other"), DEVICES),
    )


def _hand(content: Any) -> HandControls:  # noqa: ANN401  anything may come
    if not isinstance(content, dict):
        raise _refused("a hand that is no object")
    pose = content.get("pose")
    return HandControls(
        pose=None if pose is None else _pose("pose", pose),
        engaged=_flag("engaged", content.get("engaged", False)),
        grip=float(np.clip(_number("grip", content.get("grip", 0.0)), 0.0, 1.0)),
        rate=_numbers("rate", content.get("rate", [0] * 6), 6, 1.0),
    )


def _pose(name: str, content: Any) -> np.ndarray:  # noqa: ANN401
    """Return a pose (4, 4) in the robot's axes."""
    numbers = _numbers(name, content, 7, MAX_COORDINATE)
    if not 0.5 < np.linalg.norm(numbers[3:]) < 1.5:
        raise _refused(f"{name} with a quaternion of length {np.linalg.norm(numbers[3:]):.2f}")
    T = poses.pose(numbers[:3], numbers[3:])
    return poses.from_rotation(_R_robot_room @ T[:3, :3] @ _R_robot_room.T, _R_robot_room @ T[:3, 3])


def room_pose(T: np.ndarray) -> list[float]:
    """Return a pose (4, 4) in the robot's axes as a page would send it; the inverse of what is done on the way in."""
    rotation = _R_robot_room.T @ T[:3, :3] @ _R_robot_room
    position, quat_wxyz = poses.split(poses.from_rotation(rotation, _R_robot_room.T @ T[:3, 3]))
    return [*position.tolist(), *quat_wxyz.tolist()]


def _flag(name: str, content: Any) -> bool:  # noqa: ANN401
    if type(content) is not bool:
        raise _refused(f"{name} that is neither true nor false")
    return content


def _number(name: str, content: Any, limit: float = math.inf) -> float:  # noqa: ANN401
    with suppress(OverflowError):  # of an integer beyond all floats
        if type(content) in (int, float) and math.isfinite(content):
            return float(np.clip(content, -limit, limit))
    raise _refused(f"{name} that is no finite number")


def _numbers(name: str, content: Any, count: int, limit: float) -> np.ndarray:  # noqa: ANN401
    if not isinstance(content, list) or len(content) != count:
        raise _refused(f"{name} that is no list of {count} numbers")
    return np.array([_number(name, value, limit) for value in content])


def _one_of(name: str, content: Any, allowed: tuple[str, ...]) -> str:  # noqa: ANN401
    if content not in allowed:
        raise _refused(f"{name} {str(content)[:40]!r}")
    return content


def _refused(got: str) -> ProtocolError:
    return ProtocolError(got, "a message as docs/teleoperation.md has it", "mend the client")


def frame(time_s: float, tick: int, bodies: np.ndarray, targets: np.ndarray) -> bytes:
    """Return the poses of one moment as they are sent.

    Args:
        time_s: The server's clock [s].
        tick: Steps recorded.
        bodies: (bodies, 7) position and quaternion wxyz.
        targets: (2, 7) what is asked of the palms.
    """
    numbers = np.concatenate([bodies, targets]).astype("<f4")
    return _FRAME_HEADER.pack(time_s, tick, len(bodies)) + numbers.tobytes()


def status_message(status: Status, **more: Any) -> str:  # noqa: ANN401  whatever JSON can hold
    """Return a status as it is sent."""
    content = asdict(status)
    if status.verdict is not None and status.verdict.trial is not None:
        trial = status.verdict.trial
        content["verdict"]["trial"] |= {"finished": trial.finished, "hopeless": trial.hopeless}
    return json.dumps({"type": "status"} | content | more)
