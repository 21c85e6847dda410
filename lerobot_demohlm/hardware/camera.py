"""A LeRobot camera on the robot's head -> pictures and intrinsics."""

import json
import math

import numpy as np

from gym_demohlm.perception.camera import Intrinsics
from gym_demohlm.robot.neck import CAMERA_FOVY
from lerobot_demohlm.hardware.errors import RobotError

_WAIT_MS = 200


class HeadCamera:
    """One of LeRobot's cameras, such as a RealSense or ZMQ pictures.

    Args:
        text: Its configuration as JSON: ``{"type": "intelrealsense", "serial_number_or_name": "0123456789",
            "width": 640, "height": 480, "fps": 60}``.

    Raises:
        RobotError: There is no such camera.
    """

    def __init__(self, text: str) -> None:
        import draccus
        from lerobot.cameras.configs import CameraConfig
        from lerobot.cameras.utils import make_cameras_from_configs

        try:
            config = draccus.decode(CameraConfig, json.loads(text))
            self._camera = make_cameras_from_configs({"head": config})["head"]
            self._camera.connect()
        except Exception as error:  # each kind of camera raises its own
            raise RobotError(
                f"no camera {text!r} ({error})", 'such as {"type": "intelrealsense", "serial_number_or_name": "..."}',
                "check --camera, and `lerobot-find-cameras`",
            ) from error  # fmt: skip

    def color(self) -> np.ndarray | None:
        """Return the newest picture (height, width, 3) uint8 RGB; None where none comes in time."""
        try:
            return np.asarray(self._camera.async_read(timeout_ms=_WAIT_MS))
        except (TimeoutError, RuntimeError):
            return None

    def intrinsics(self, shape: tuple[int, ...]) -> Intrinsics:
        """Return those that a RealSense tells, both focal lengths as one, else a D435's by its data sheet."""
        height, width = shape[:2]
        profile = getattr(self._camera, "rs_profile", None)
        if profile is None:
            focal = 0.5 * height / math.tan(0.5 * math.radians(CAMERA_FOVY))
            middle = 0.5 * (width - 1), 0.5 * (height - 1)
            return Intrinsics(width=width, height=height, focal=focal, center_u=middle[0], center_v=middle[1])
        import pyrealsense2  # of LeRobot's extra intelrealsense, without which there is no such camera

        told = profile.get_stream(pyrealsense2.stream.color).as_video_stream_profile().get_intrinsics()
        focal = 0.5 * (told.fx + told.fy)
        return Intrinsics(width=width, height=height, focal=focal, center_u=told.ppx, center_v=told.ppy)

    def close(self) -> None:
        """Give the camera back."""
        self._camera.disconnect()
