"""LeRobot's cameras on the head: when a picture was taken, where the lens is, and what nobody knows."""

import json
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import lerobot.cameras.utils
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.perception.camera import T_OPTICAL_CAMERA
from lerobot_demohlm.hardware.camera import HeadCamera, read_camera
from lerobot_demohlm.hardware.errors import RobotError

REALSENSE = {"type": "intelrealsense", "serial_number_or_name": "0123456789"}
OPENCV = {"type": "opencv", "index_or_path": 0}
POSE = [0.01, 0.02, 0.03, 1.0, 0.0, 0.0, 0.0]


class Lens:
    """One of LeRobot's cameras, with the parts of it that are used."""

    def __init__(self, name: str = "Intel RealSense D435I") -> None:
        self.frame_lock, self.latest_frame, self.latest_timestamp = threading.Lock(), np.zeros((4, 6, 3), np.uint8), 0.0
        self.connected = False
        told = SimpleNamespace(fx=610.0, fy=612.0, ppx=321.0, ppy=243.0)
        stream = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: told))
        device = SimpleNamespace(get_info=lambda _: name)
        self.rs_profile = SimpleNamespace(get_stream=lambda _: stream, get_device=lambda: device)

    def connect(self) -> None:
        self.connected = True

    def disconnect(self) -> None:
        self.connected = False

    def async_read(self, timeout_ms: float) -> np.ndarray:
        return self.latest_frame


@pytest.fixture
def lens(monkeypatch: pytest.MonkeyPatch) -> Lens:
    made = Lens()
    library = SimpleNamespace(stream=SimpleNamespace(color=0), camera_info=SimpleNamespace(name=0))
    monkeypatch.setitem(sys.modules, "pyrealsense2", library)
    monkeypatch.setattr(lerobot.cameras.utils, "make_cameras_from_configs", lambda _: {"head": made})
    return made


def test_a_d435_has_its_lens_to_the_left_of_its_middle_and_tells_how_it_sees(lens: Lens) -> None:
    camera = HeadCamera(json.dumps(REALSENSE))
    np.testing.assert_allclose(camera.T_camera_optical @ T_OPTICAL_CAMERA, poses.pose([0.0, 0.0325, 0.0]), atol=1e-12)
    known = camera.intrinsics((480, 640, 3))
    assert (known.focal, known.center_u, known.center_v) == (611.0, 321.0, 243.0)
    camera.close()
    assert not lens.connected


def test_another_realsense_has_to_say_where_its_lens_is(lens: Lens) -> None:
    lens.__init__("Intel RealSense D455")
    with pytest.raises(RobotError, match=r'D455.*"calibration"'):
        HeadCamera(json.dumps(REALSENSE))
    assert not lens.connected
    camera = HeadCamera(json.dumps(REALSENSE | {"calibration": {"pose": POSE}}))
    np.testing.assert_allclose(camera.T_camera_optical @ T_OPTICAL_CAMERA, poses.pose(POSE[:3]), atol=1e-12)


def test_a_calibration_goes_before_what_a_camera_tells(lens: Lens) -> None:
    told = {"pose": POSE, "focal_px": 500.0}
    for config in (REALSENSE, OPENCV):
        known = HeadCamera(json.dumps(config | {"calibration": told})).intrinsics((480, 640, 3))
        assert (known.focal, known.center_u, known.center_v) == (500.0, 319.5, 239.5)
    told["center_px"] = [310.0, 230.0]  # pyright: ignore[reportArgumentType]
    known = HeadCamera(json.dumps(OPENCV | {"calibration": told})).intrinsics((480, 640, 3))
    assert (known.center_u, known.center_v) == (310.0, 230.0)


@pytest.mark.parametrize("kind", ["opencv", "zmq", "intelrealsense"])
def test_lerobots_cameras_are_known(kind: str) -> None:
    """Also to a process that imports nothing else: here none of them is there, and each says so itself."""
    text = {
        "opencv": OPENCV | {"index_or_path": "/dev/no_such_camera"},
        "zmq": {"type": "zmq", "server_address": "127.0.0.1", "port": 9, "camera_name": "head", "timeout_ms": 50},
        "intelrealsense": REALSENSE,
    }[kind] | {"calibration": {"pose": POSE, "focal_px": 500.0}}
    code = (
        "import sys\n"
        "from lerobot_demohlm.hardware.camera import HeadCamera\n"
        "from lerobot_demohlm.hardware.errors import RobotError\n"
        "try:\n    HeadCamera(sys.argv[1])\nexcept RobotError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, json.dumps(text)], capture_output=True, text=True, check=True)
    assert "no camera" in done.stdout and "choice class" not in done.stdout


@pytest.mark.parametrize("delay_s", [0.0, 0.04])
def test_a_picture_was_taken_when_its_camera_says_less_the_delay(lens: Lens, delay_s: float) -> None:
    camera = HeadCamera(json.dumps(REALSENSE | {"calibration": {"delay_s": delay_s}}))
    lens.latest_timestamp = time.perf_counter() - 0.2
    before_ns = time.monotonic_ns()
    picture = camera.picture()
    assert picture is not None
    assert 1e-9 * (before_ns - picture.time_ns) == pytest.approx(0.2 + delay_s, abs=0.02)

    def overtaken(timeout_ms: float) -> np.ndarray:
        """A newer picture comes right after the one that was waited for."""
        old, lens.latest_frame = lens.latest_frame, np.full((4, 6, 3), 7, np.uint8)
        lens.latest_timestamp = time.perf_counter()
        return old

    lens.async_read = overtaken  # pyright: ignore[reportAttributeAccessIssue]
    picture = camera.picture()
    assert picture is not None and (picture.image == 7).all(), "picture and time are of one frame"

    def late(timeout_ms: float) -> np.ndarray:
        raise TimeoutError

    lens.async_read = late  # pyright: ignore[reportAttributeAccessIssue]
    assert camera.picture() is None


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (OPENCV, "lens nobody knows"),
        (OPENCV | {"calibration": {"pose": POSE}}, "lens nobody knows"),
        (OPENCV | {"calibration": {"focal_px": 600.0}}, "lens nobody knows"),
        (REALSENSE | {"calibration": {"pose": POSE[:3]}}, "a pose of"),
        (REALSENSE | {"calibration": {"pose": [0, 0, 0, 0, 0, 0, 0]}}, "a pose of"),
        (REALSENSE | {"calibration": {"focal_px": 0.0}}, "at least 1"),
        (REALSENSE | {"calibration": {"center_px": [1.0, 2.0]}}, "without focal_px"),
        (REALSENSE | {"calibration": {"delay_s": -0.1}}, "at least 0"),
        (REALSENSE | {"calibration": {"focus": 3.0}}, "unknown: focus"),
        ([1, 2], "the camera"),
    ],
)
def test_what_is_wrong_or_missing_is_said_before_anything_is_opened(config: Any, said: str) -> None:
    with pytest.raises(RobotError, match=said):
        read_camera(json.dumps(config))
