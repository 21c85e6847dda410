"""A LeRobot camera on the robot's head -> pictures, when each was taken, and through which lens.

LeRobot does not know where on the head a lens is, and only of a RealSense how it sees. What it does not know stands in
the camera's JSON as ``calibration``; a D435 needs none.
"""

import json
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import T_CAMERA_OPTICAL, Intrinsics
from lerobot_demohlm.hardware.errors import RobotError

REALSENSE = "intelrealsense"
LENS_OF_D435 = (0.0, 0.0325, 0.0)
"""Where a D435 has its colour lens in the frame ``head_camera`` [m], which is in the middle of its housing's front.

As Intel's realsense2_description has it (``_d435.urdf.xacro``): the left infrared eye is 17.5 mm to the left of the
middle, as the camera looks, and the colour lens 15 mm to the left of that. A D435i has the same housing.
"""
_WAIT_MS = 200
_EXAMPLE = '{"type": "intelrealsense", "serial_number_or_name": "..."}'
_CALIBRATION = '"calibration": {"pose": [x, y, z, qw, qx, qy, qz], "focal_px": f, "center_px": [u, v], "delay_s": 0.0}'


@dataclass(frozen=True, kw_only=True)
class Picture:
    """What a camera saw.

    Attributes:
        image: (height, width, 3) uint8 RGB.
        time_ns: When it was taken (``time.monotonic_ns``).
    """

    image: np.ndarray
    time_ns: int


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What is known of a camera beside what it tells itself.

    Attributes:
        T_camera_lens: (4, 4) its lens in the frame ``head_camera``: x out of the lens, y left, z up; None for the place
            in which a D435 has its own.
        focal: Focal length, the same both ways [px]; None for what a RealSense tells.
        center: Column and row of the optical axis [px]; None for the middle of the picture, with a focal length.
        delay_s: From the exposure to when LeRobot has the picture [s].
    """

    T_camera_lens: np.ndarray | None = None
    focal: float | None = None
    center: tuple[float, float] | None = None
    delay_s: float = 0.0


def read_camera(text: str) -> tuple[dict[str, Any], Calibration]:
    """Return LeRobot's configuration of a camera, and its calibration.

    Args:
        text: JSON of the configuration, and ``calibration`` in it.

    Raises:
        RobotError: It is no JSON of a camera, or a camera that is no RealSense does not say how it sees.
    """
    try:
        config = json.loads(text)
        told = config.pop("calibration", {})
        kind = config.get("type")
        unknown = set(told) - {"pose", "focal_px", "center_px", "delay_s"}
        if unknown:
            raise ValueError(f"unknown: {', '.join(sorted(unknown))}")
        calibration = Calibration(
            T_camera_lens=_pose(told["pose"]) if "pose" in told else None,
            focal=_number(told["focal_px"], 1.0) if "focal_px" in told else None,
            center=_center(*told["center_px"]) if "center_px" in told else None,
            delay_s=_number(told.get("delay_s", 0.0), 0.0),
        )
        if calibration.center is not None and calibration.focal is None:
            raise ValueError("center_px without focal_px")
    except (ValueError, TypeError, AttributeError) as error:
        expected = f"such as {_EXAMPLE}, perhaps with {_CALIBRATION}"
        raise RobotError(f"the camera {text!r} ({error})", expected, "correct --camera") from error
    if kind != REALSENSE and (calibration.T_camera_lens is None or calibration.focal is None):
        raise RobotError(
            f"a camera of type {kind!r} whose lens nobody knows", "its place on the head and its focal length",
            f"add {_CALIBRATION} to --camera; docs/deployment.md says how to measure them",
        )  # fmt: skip
    return config, calibration


class HeadCamera:
    """One of LeRobot's cameras, such as a RealSense or ZMQ pictures.

    Args:
        text: Its configuration as JSON: ``{"type": "intelrealsense", "serial_number_or_name": "0123456789",
            "width": 640, "height": 480, "fps": 60}``; see ``read_camera``.

    Attributes:
        T_camera_optical: (4, 4) the frame ``optical`` of its lens in the frame ``head_camera``.

    Raises:
        RobotError: There is no such camera, or nobody knows where its lens is.
    """

    def __init__(self, text: str) -> None:
        import draccus
        from lerobot.cameras import opencv, reachy2_camera, realsense, zmq  # noqa: F401 - each makes its type known
        from lerobot.cameras.configs import CameraConfig
        from lerobot.cameras.utils import make_cameras_from_configs

        config, self._calibration = read_camera(text)
        try:
            decoded = draccus.decode(CameraConfig, config)
            self._camera = make_cameras_from_configs({"head": decoded})["head"]
            self._camera.connect()
        except Exception as error:  # each kind of camera raises its own
            raise RobotError(
                f"no camera {text!r} ({error})", f"such as {_EXAMPLE}", "check --camera, and `lerobot-find-cameras`"
            ) from error
        lens = self._calibration.T_camera_lens
        if lens is None:
            self._refuse_other_housing()
            lens = poses.pose(np.array(LENS_OF_D435))
        self.T_camera_optical = lens @ T_CAMERA_OPTICAL

    def picture(self) -> Picture | None:
        """Return the newest picture; None where none comes in time."""
        camera = self._camera
        try:
            image = camera.async_read(timeout_ms=_WAIT_MS)
        except (TimeoutError, RuntimeError):
            return None
        age_s = self._calibration.delay_s
        if hasattr(camera, "frame_lock"):  # a camera with a thread of its own, which notes when a picture has come
            with camera.frame_lock:
                image = camera.latest_color_frame if hasattr(camera, "latest_color_frame") else camera.latest_frame
                came_s = camera.latest_timestamp
            if image is None or came_s is None:
                return None
            age_s += time.perf_counter() - came_s
        return Picture(image=np.asarray(image), time_ns=time.monotonic_ns() - round(1e9 * age_s))

    def intrinsics(self, shape: tuple[int, ...]) -> Intrinsics:
        """Return those of the calibration, else those that a RealSense tells, both focal lengths as one."""
        height, width = shape[:2]
        focal, center = self._calibration.focal, self._calibration.center
        if focal is None:
            import pyrealsense2  # of LeRobot's extra intelrealsense, without which there is no such camera

            stream = self._camera.rs_profile.get_stream(pyrealsense2.stream.color)
            told = stream.as_video_stream_profile().get_intrinsics()
            focal, center = 0.5 * (told.fx + told.fy), (told.ppx, told.ppy)
        u, v = center or (0.5 * (width - 1), 0.5 * (height - 1))
        return Intrinsics(width=width, height=height, focal=focal, center_u=u, center_v=v)

    def close(self) -> None:
        """Give the camera back."""
        self._camera.disconnect()

    def _refuse_other_housing(self) -> None:
        """Check that a RealSense is a D435."""
        import pyrealsense2

        name = self._camera.rs_profile.get_device().get_info(pyrealsense2.camera_info.name)
        if "D435" not in name:
            self.close()
            raise RobotError(
                f"a {name}, whose colour lens is elsewhere than a D435's", "its place on the head",
                'add "calibration": {"pose": [x, y, z, qw, qx, qy, qz]} to --camera',
            )  # fmt: skip


def _pose(numbers: list[float]) -> np.ndarray:
    values = np.asarray(numbers, dtype=np.float64)
    if values.shape != (7,) or not np.isfinite(values).all() or np.linalg.norm(values[3:]) < 0.5:
        raise ValueError(f"a pose of {numbers}")
    return poses.pose(values[:3], values[3:] / np.linalg.norm(values[3:]))


def _center(u: float, v: float) -> tuple[float, float]:
    return _number(u, 0.0), _number(v, 0.0)


def _number(value: float, least: float) -> float:
    number = float(value)
    if not least <= number < math.inf:
        raise ValueError(f"{number} where at least {least:g} belongs")
    return number
