"""A camera's images and a file of tags -> poses of objects that carry AprilTags (36h11).

The file says for each object which tags it carries: ``{"box": [{"id": 3, "size_m": 0.05, "pose": [x, y, z, qw, qx, qy,
qz]}]}``. The pose is of the tag in the object's frame: its x to the right of the printed tag, y up, z out of it.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import T_OPTICAL_CAMERA
from gym_demohlm.robot.neck import CAMERA_FOVY
from gym_demohlm.task import Task
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.look import Look


@dataclass(frozen=True, kw_only=True)
class Tag:
    """A tag on an object.

    Attributes:
        id: Of the family 36h11.
        size_m: Length of the side of its black square [m].
        T_object_tag: (4, 4).
    """

    id: int
    size_m: float
    T_object_tag: np.ndarray


def read_tags(path: Path, names: Sequence[str]) -> dict[str, tuple[Tag, ...]]:
    """Return the tags of each object.

    Raises:
        RobotError: The file cannot be read, or an object has none.
    """
    try:
        content = json.loads(path.read_text())
        found = {name: tuple(_tag(entry) for entry in entries) for name, entries in content.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RobotError(
            f"tags that cannot be read ({error})", '{"box": [{"id": 3, "size_m": 0.05, "pose": [7 numbers]}]}',
            "see docs/deployment.md",
        ) from error  # fmt: skip
    missing = [name for name in names if not found.get(name)]
    if missing:
        raise RobotError(f"no tag on {', '.join(missing)}", "one on each object of the task", f"add it to {path.name}")
    return found


def _tag(entry: Mapping[str, Any]) -> Tag:
    numbers = np.array(entry["pose"], dtype=float)
    if numbers.shape != (7,) or not np.isfinite(numbers).all() or float(entry["size_m"]) <= 0.0:
        raise ValueError(f"tag {entry.get('id')} without seven numbers and a size")
    quat = numbers[3:] / np.linalg.norm(numbers[3:])
    return Tag(id=int(entry["id"]), size_m=float(entry["size_m"]), T_object_tag=poses.pose(numbers[:3], quat))


class TagFinder:
    """Finds objects in images.

    Args:
        tags: Of each object.
        intrinsics: (3, 3) of the camera [px].
    """

    def __init__(self, tags: Mapping[str, Sequence[Tag]], intrinsics: np.ndarray) -> None:
        self._tags = {tag.id: (name, tag) for name, each in tags.items() for tag in each}
        self._intrinsics = intrinsics
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def find(self, image: np.ndarray) -> dict[str, np.ndarray]:
        """Return the poses (4, 4) in the frame ``head_camera`` of the objects whose tags are seen, of the nearest tag.

        Args:
            image: (height, width, 3) uint8 RGB.
        """
        corners, numbers, _ = self._detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        found: dict[str, tuple[float, np.ndarray]] = {}
        for each, number in zip(corners, [] if numbers is None else map(int, numbers.ravel()), strict=True):
            if number not in self._tags:
                continue
            name, tag = self._tags[number]
            half = 0.5 * tag.size_m
            points = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
            good, turn, place = cv2.solvePnP(
                points, each.reshape(4, 2).astype(np.float64), self._intrinsics, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            distance = float(np.linalg.norm(place))
            if not good or not math.isfinite(distance) or (name in found and found[name][0] <= distance):
                continue
            T_optical_tag = poses.from_rotation(cv2.Rodrigues(turn)[0], place.ravel())
            found[name] = distance, poses.invert(T_OPTICAL_CAMERA) @ T_optical_tag @ poses.invert(tag.T_object_tag)
        return {name: T for name, (_, T) in found.items()}


class TagSource:
    """Looks through one of LeRobot's cameras, such as a RealSense or ZMQ pictures.

    Args:
        task: The task.
        tags: File of tags.
        camera: The camera's configuration as JSON, with its "type".

    Raises:
        RobotError: The file or the camera cannot be opened.
    """

    def __init__(self, task: Task, tags: Path, camera: str) -> None:
        self._names = [entry.name for entry in task.objects]
        known = read_tags(tags, self._names)
        self._camera = open_camera(camera)
        self._finder: TagFinder | None = None
        self._tags = known
        self._last: dict[str, tuple[np.ndarray, int]] = {}

    def __call__(self) -> Look | None:
        """Return the newest look; None before each object was seen once, and where no picture comes."""
        try:
            image = np.asarray(self._camera.async_read(timeout_ms=200))
        except (TimeoutError, RuntimeError):
            return None
        now = time.monotonic_ns()
        if self._finder is None:
            self._finder = TagFinder(self._tags, intrinsics_of(self._camera, image.shape))
        seen = self._finder.find(image)
        self._last |= {name: (T, now) for name, T in seen.items()}
        if len(self._last) < len(self._names) or not seen:
            return None
        return Look(
            T_camera_object=np.stack([self._last[name][0] for name in self._names]),
            valid=np.array([name in seen for name in self._names]),
            age_s=np.array([1e-9 * (now - self._last[name][1]) for name in self._names]),
            time_ns=now,
        )


def open_camera(text: str) -> Any:  # noqa: ANN401
    """Return a connected camera of LeRobot.

    Args:
        text: Its configuration as JSON: ``{"type": "intelrealsense", "serial_number_or_name": "0123456789",
            "width": 640, "height": 480, "fps": 60}``.

    Raises:
        RobotError: There is no such camera.
    """
    import draccus
    from lerobot.cameras.configs import CameraConfig
    from lerobot.cameras.utils import make_cameras_from_configs

    try:
        config = draccus.decode(CameraConfig, json.loads(text))
        camera = make_cameras_from_configs({"head": config})["head"]
        camera.connect()
    except Exception as error:  # each kind of camera raises its own
        raise RobotError(
            f"no camera {text!r} ({error})", 'such as {"type": "intelrealsense", "serial_number_or_name": "..."}',
            "check --camera, and `lerobot-find-cameras`",
        ) from error  # fmt: skip
    return camera


def intrinsics_of(camera: Any, shape: tuple[int, ...]) -> np.ndarray:  # noqa: ANN401
    """Return the intrinsics (3, 3) [px]: those that a RealSense tells, else a D435's by its data sheet."""
    height, width = shape[:2]
    profile = getattr(camera, "rs_profile", None)
    if profile is not None:
        import pyrealsense2  # of LeRobot's extra intelrealsense, without which there is no such camera

        told = profile.get_stream(pyrealsense2.stream.color).as_video_stream_profile().get_intrinsics()
        return np.array([[told.fx, 0.0, told.ppx], [0.0, told.fy, told.ppy], [0.0, 0.0, 1.0]])
    focal = 0.5 * height / math.tan(0.5 * math.radians(CAMERA_FOVY))
    return np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
