"""What an environment and a pose server say to each other over ZMQ: pictures one way, poses the other.

A request has a JSON header and then raw parts: the colour picture as JPEG, the depth picture as zlib of uint16, and
the objects' masks, one after the other, as zlib of uint8 (empty where the server is to find them). An answer is one
JSON object. ``docs/perception.md`` lists the fields.
"""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.timing import STEP_DT

VERSION = 1
DEPTH_UNIT = 1e-4  # m
_LARGEST = 4096  # px of a picture's side
_ROUGHLY = 1e-2  # by which the columns of a rotation matrix may miss length 1 and right angles


@dataclass(frozen=True, kw_only=True)
class Request:
    """What a pose server is asked.

    Attributes:
        session: Says which requests are of one episode of one world.
        frame: Number of the picture in the session, from 0.
        task: Name of the task.
        objects: Names of the objects that are looked for.
        K: (3, 3) the camera's matrix as the robot knows it.
        T_odom_optical: (4, 4) the camera's pose in odometry coordinates; z of the frame ``optical`` looks forward.
        hands: Poses (4, 4) of the palms in odometry coordinates, by side.
        color: (height, width, 3) uint8.
        depth: (height, width) float32 [m], 0 where nothing was measured.
        masks: (height, width) bool, one an object; None where the server is to find them.
        dt_s: Time since the session's last picture [s].
        region: "R4" where the objects have the shapes of R4, see ``Task.form``; else empty.
    """

    session: str
    frame: int
    task: str
    objects: tuple[str, ...]
    K: np.ndarray
    T_odom_optical: np.ndarray
    hands: dict[str, np.ndarray]
    color: np.ndarray
    depth: np.ndarray
    masks: tuple[np.ndarray, ...] | None
    dt_s: float = STEP_DT
    region: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a pose server says of one object.

    Attributes:
        T_optical_object: (4, 4); whatever where it is not valid.
        valid: Whether the picture showed the object.
        reason: Why it did not, in words.
    """

    T_optical_object: np.ndarray
    valid: bool
    reason: str = ""


def pack_request(request: Request) -> list[bytes]:
    """Return the parts of a message."""
    header = {
        "version": VERSION,
        "session": request.session,
        "frame": request.frame,
        "task": request.task,
        "objects": list(request.objects),
        "height": request.depth.shape[0],
        "width": request.depth.shape[1],
        "depth_unit_m": DEPTH_UNIT,
        "K": request.K.ravel().tolist(),
        "T_odom_optical": request.T_odom_optical.ravel().tolist(),
        "hands": {side: T.ravel().tolist() for side, T in request.hands.items()},
        "dt_s": request.dt_s,
        "region": request.region,
    }
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(request.color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])
    steps = np.clip(np.round(request.depth / DEPTH_UNIT), 0, 65535).astype("<u2")
    masks = b"" if request.masks is None else np.stack(request.masks).astype(np.uint8).tobytes()
    return [
        json.dumps(header).encode(),
        jpeg.tobytes(),
        zlib.compress(steps.tobytes(), 1),
        zlib.compress(masks, 1) if masks else b"",
    ]


def unpack_request(parts: Sequence[bytes]) -> Request:
    """Return the request of a message.

    Raises:
        SceneError: It is none.
    """
    try:
        header = json.loads(parts[0])
        if header["version"] != VERSION:
            raise ValueError(f"version {header['version']}, not {VERSION}")
        shape = int(header["height"]), int(header["width"])
        if not (0 < shape[0] <= _LARGEST and 0 < shape[1] <= _LARGEST):
            raise ValueError(f"a picture of {shape}")
        names = tuple(str(name) for name in header["objects"])
        color = cv2.imdecode(np.frombuffer(parts[1], np.uint8), cv2.IMREAD_COLOR)
        if color is None or color.shape[:2] != shape:
            raise ValueError("a colour picture of another size")
        steps = np.frombuffer(_unzipped(parts[2], 2 * shape[0] * shape[1]), "<u2").reshape(shape)
        masks = None
        if parts[3]:
            flat = np.frombuffer(_unzipped(parts[3], len(names) * shape[0] * shape[1]), np.uint8)
            masks = tuple(flat.reshape(len(names), *shape).astype(bool))
        return Request(
            session=str(header["session"]),
            frame=int(header["frame"]),
            task=str(header["task"]),
            objects=names,
            K=_matrix(header["K"], 3),
            T_odom_optical=_matrix(header["T_odom_optical"], 4),
            hands={str(side): _matrix(T, 4) for side, T in header["hands"].items()},
            color=cv2.cvtColor(color, cv2.COLOR_BGR2RGB),
            depth=(steps * np.float32(header["depth_unit_m"])).astype(np.float32),
            masks=masks,
            dt_s=_time(header.get("dt_s", STEP_DT)),
            region=str(header.get("region", "")),
        )
    except (
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
        cv2.error,
        zlib.error,
    ) as error:
        got = f"a request that cannot be read ({error})"
        raise SceneError(got, "one of `wire.pack_request`", "send one") from error


def pack_answers(frame: int, answers: Sequence[Answer], server_ms: float) -> bytes:
    """Return the message that answers a request.

    Args:
        frame: Of the request.
        answers: One an object, in the order of the request.
        server_ms: Time that it took [ms].
    """
    objects = [
        {
            "T_optical_object": np.asarray(answer.T_optical_object, dtype=np.float64).ravel().tolist(),
            "valid": bool(answer.valid),  # which may be NumPy's
            "reason": str(answer.reason),
        }
        for answer in answers
    ]
    return json.dumps({"frame": frame, "objects": objects, "server_ms": round(server_ms, 3)}).encode()


def unpack_answers(message: bytes, num_objects: int) -> tuple[int, list[Answer]]:
    """Return the frame that is answered, and an answer for each object.

    Raises:
        ValueError: In a few words, what is wrong with the message: no JSON, a wrong shape, not finite, no rotation.
    """
    try:
        content = json.loads(message)
        frame, entries = int(content["frame"]), content["objects"]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        raise ValueError("no answer in JSON") from None
    if not isinstance(entries, list) or len(entries) != num_objects:
        raise ValueError("another number of objects")
    return frame, [_answer(entry) for entry in entries]


def _answer(entry: Any) -> Answer:  # noqa: ANN401
    try:
        T, valid, reason = np.asarray(entry["T_optical_object"], dtype=np.float64), entry["valid"], entry["reason"]
    except (ValueError, KeyError, TypeError, OverflowError):
        raise ValueError("no pose in an answer") from None
    if not valid:
        return Answer(T_optical_object=np.eye(4), valid=False, reason=str(reason)[:80])
    if T.shape not in ((16,), (4, 4)):
        raise ValueError("a pose of a wrong shape")
    T = T.reshape(4, 4)
    if not np.isfinite(T).all():
        raise ValueError("a pose that is not finite")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ROUGHLY or np.linalg.det(R) < 0 or (T[3] != (0, 0, 0, 1)).any():
        raise ValueError("a pose that is no rotation and shift")
    return Answer(T_optical_object=T, valid=True)


def _matrix(values: Any, size: int) -> np.ndarray:  # noqa: ANN401
    matrix = np.asarray(values, dtype=np.float64)
    if matrix.size != size * size or not np.isfinite(matrix).all():
        raise ValueError(f"a matrix of {matrix.size} numbers")
    return matrix.reshape(size, size)


def _time(value: Any) -> float:  # noqa: ANN401
    time_s = float(value)
    if not 0.0 <= time_s < np.inf:
        raise ValueError(f"a time of {time_s} s")
    return time_s


def _unzipped(content: bytes, size: int) -> bytes:
    """Return what zlib packed, if it is as long as it should be; never more."""
    found = zlib.decompressobj().decompress(content, size + 1)
    if len(found) != size:
        raise ValueError(f"{len(found)} bytes or more instead of {size}")
    return found
