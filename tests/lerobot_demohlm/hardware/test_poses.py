"""Where objects are: from a simulated world, over UDP, and from AprilTags in a picture."""

import json
import socket
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.perception.camera import T_CAMERA_OPTICAL
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.hardware import robot_observation, world_topic
from lerobot_demohlm.hardware.apriltag import Tag, TagFinder, read_tags
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import WORLD, Link
from lerobot_demohlm.hardware.pose_process import PoseSettings, RemoteSource, WorldSource, _record
from tests.helpers.robot import free_domain

TASK = get_task("LiftBox")


def test_exact_poses_of_another_processes_world_are_those_of_the_environment() -> None:
    sim = Simulation(TASK)
    for _ in range(4):
        sim.step(command.rest()[None])
    link = Link("lo", free_domain())
    source, writer = WorldSource(TASK, "exact", link), link.writer(WORLD)
    snapshot, look, until = sim.snapshot(), None, time.monotonic() + 20.0
    assert source() is None
    while look is None and time.monotonic() < until:
        writer.send(world_topic.pack(0, 0.4, snapshot["physics"][0], snapshot["mocap"][0]))
        time.sleep(0.02)
        look = source()
    assert look is not None
    seen = robot_observation.environment_state(_record(look, 0.0), len(TASK.objects))
    np.testing.assert_array_equal(seen, observation.environment_state(sim)[0])
    sim.close()


def test_a_world_goes_through_its_message() -> None:
    rng = np.random.default_rng(0)
    physics, mocap = rng.normal(size=77), rng.normal(size=14)
    episode, time_s, *arrays = world_topic.unpack(world_topic.pack(3, 1.5, physics, mocap))
    assert (episode, time_s) == (3, 1.5)
    np.testing.assert_array_equal(np.concatenate(arrays), np.concatenate([physics, mocap]))
    with pytest.raises(ValueError, match="numbers; expected"):
        world_topic.unpack(world_topic.pack(3, 1.5, physics, mocap)[:-8])


@pytest.mark.parametrize("message", [
    b"no json", b"[]", b'{"objects": {"box": [1, 2]}}', b'{"objects": {"box": [0, 0, 0, 1, 1, 1, 1]}}',
    b'{"objects": {"cat": [0, 0, 0, 1, 0, 0, 0]}}', b'{"age_s": -1, "objects": {"box": [0, 0, 0, 1, 0, 0, 0]}}',
    b'{"objects": {"box": [NaN, 0, 0, 1, 0, 0, 0]}}', b'{"age_s": "x", "objects": {}}',
])  # fmt: skip
def test_remote_poses_that_are_none_are_dropped(message: bytes) -> None:
    source = RemoteSource(TASK, "lo", 0)
    _send(source, message)
    assert source() is None


def _send(source: RemoteSource, message: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(message, ("127.0.0.1", source._socket.getsockname()[1]))


def test_remote_poses_have_the_age_that_they_say() -> None:
    source, name = RemoteSource(TASK, "lo", 0), TASK.objects[0].name
    numbers = [0.5, 0.1, -0.2, 0.0, 0.0, 0.0, 1.0]
    before = time.monotonic_ns()
    _send(source, json.dumps({"age_s": 0.25, "objects": {name: numbers}}).encode())
    look = source()
    assert look is not None
    np.testing.assert_allclose(look.T_camera_object[0], poses.pose(numbers[:3], numbers[3:]), atol=1e-12)
    assert look.time_ns >= before - 0.2501e9 and look.time_ns <= time.monotonic_ns() - 0.249e9
    assert look.valid.all() and source() is None


def test_sources_that_do_not_exist_or_lack_something_are_refused(tmp_path: Path) -> None:
    def make(source: str) -> PoseSettings:
        return PoseSettings(source=source, task="LiftBox", folder=tmp_path, interface="lo")

    with pytest.raises(UnknownNameError, match="did you mean 'exact'"):
        make("exakt")
    with pytest.raises(RobotError, match="give --tags"):
        make("apriltag")
    (tmp_path / "tags.json").write_text('{"box": []}')
    with pytest.raises(RobotError, match="no tag on box"):
        read_tags(tmp_path / "tags.json", ["box"])
    (tmp_path / "tags.json").write_text('{"box": [{"id": 1, "size_m": 0.05, "pose": [0, 0]}]}')
    with pytest.raises(RobotError, match="tags that cannot be read"):
        read_tags(tmp_path / "tags.json", ["box"])


def picture_of_tag(number: int, size_m: float, T_optical_tag: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return a picture (480, 640, 3) of a printed tag on white paper, drawn by its homography."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side, margin = 400, 100
    paper = np.full((side + 2 * margin, side + 2 * margin), 255, np.uint8)
    paper[margin:-margin, margin:-margin] = cv2.aruco.generateImageMarker(dictionary, number, side)
    scale = size_m / side  # metres a pixel; the tag's x to the right, y up
    whole = len(paper)
    corners = np.array([[0, 0], [whole, 0], [whole, whole], [0, whole]], dtype=np.float32)
    flat = (corners - whole / 2) * [scale, -scale]
    p_optical = poses.transform(T_optical_tag, np.column_stack([flat, np.zeros(4)]))
    pixels = p_optical @ intrinsics.T
    pixels = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
    grey = cv2.warpPerspective(paper, cv2.getPerspectiveTransform(corners, pixels), (640, 480), borderValue=120)
    return np.repeat(grey[:, :, None], 3, axis=2)


@pytest.mark.parametrize("turn", [0.25, 0.4, -0.5])
def test_a_tag_in_a_picture_gives_the_pose_of_its_object(turn: float) -> None:
    intrinsics = np.array([[617.0, 0, 319.5], [0, 617.0, 239.5], [0, 0, 1]])
    facing = poses.from_rotation(np.diag([1.0, -1.0, -1.0]), [0.05, -0.03, 0.7])  # its z towards the camera
    T_optical_tag = facing @ poses.from_rotation(poses.rotation_from_vector([0.0, turn, 0.1]))
    T_object_tag = poses.pose([0.02, 0.03, 0.09], [0.5, 0.5, 0.5, 0.5])
    finder = TagFinder({"box": (Tag(id=7, size_m=0.08, T_object_tag=T_object_tag),)}, intrinsics)
    found = finder.find(picture_of_tag(7, 0.08, T_optical_tag, intrinsics))["box"]
    expected = T_CAMERA_OPTICAL @ T_optical_tag @ poses.invert(T_object_tag)
    assert np.linalg.norm(found[:3, 3] - expected[:3, 3]) < 0.01
    assert np.linalg.norm(poses.rotation_vector(found[:3, :3].T @ expected[:3, :3])) < 0.06
    assert finder.find(picture_of_tag(8, 0.08, T_optical_tag, intrinsics)) == {}
