"""Where objects are: in a simulated world, by a pose server, and by AprilTags in a camera's pictures."""

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.perception.camera import T_CAMERA_OPTICAL, Intrinsics, head_intrinsics
from gym_demohlm.perception.equivalents import nearest_equivalent
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.perception.tag_file import read_tags
from gym_demohlm.perception.wire import Request
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.hardware import pose_process, records, robot_observation, world_topic
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import WORLD, Link
from lerobot_demohlm.hardware.odometry import odometry_camera
from lerobot_demohlm.hardware.pose_process import PoseProcess, PoseSettings, _record
from lerobot_demohlm.hardware.pose_sources import Look, ServerSource, TagSource, WorldSource, _Seen
from lerobot_demohlm.hardware.records import Mode
from tests.helpers.pose_servers import replying, told
from tests.helpers.robot import free_domain

TASK = get_task("LiftBox")


def test_exact_poses_of_another_processes_world_are_those_of_the_environment() -> None:
    sim = Simulation(TASK)
    for _ in range(4):
        sim.step(command.rest()[None])
    link = Link("lo", free_domain())
    source, writer = WorldSource(TASK, "exact", link), link.writer(WORLD)
    snapshot, look, until = sim.snapshot(), None, time.monotonic() + 20.0
    state = records.record("state", T_odometry_torso=np.eye(4))
    camera = odometry_camera(state, None)
    assert source(camera) is None
    while look is None and time.monotonic() < until:
        writer.send(world_topic.pack(0, 0.4, snapshot["physics"][0], snapshot["mocap"][0]))
        time.sleep(0.02)
        look = source(camera)
    assert look is not None
    record = _record(look, 0.0)
    seen = robot_observation.environment_state(record, state, None, len(TASK.objects))
    np.testing.assert_allclose(seen, observation.environment_state(sim)[0], atol=1e-6)
    sim.close()


def test_a_world_goes_through_its_message() -> None:
    rng = np.random.default_rng(0)
    physics, mocap = rng.normal(size=77), rng.normal(size=14)
    episode, time_s, *arrays = world_topic.unpack(world_topic.pack(3, 1.5, physics, mocap))
    assert (episode, time_s) == (3, 1.5)
    np.testing.assert_array_equal(np.concatenate(arrays), np.concatenate([physics, mocap]))
    with pytest.raises(ValueError, match="numbers; expected"):
        world_topic.unpack(world_topic.pack(3, 1.5, physics, mocap)[:-8])


class Pictures:
    """A camera that shows the pictures that it is given, then none."""

    def __init__(self, pictures: list[np.ndarray], known: Intrinsics) -> None:
        self._pictures, self._known = pictures, known

    def color(self) -> np.ndarray | None:
        return self._pictures.pop(0) if self._pictures else None

    def intrinsics(self, shape: tuple[int, ...]) -> Intrinsics:
        return self._known


def test_a_server_is_asked_about_a_cameras_pictures_and_its_silence_is_silence() -> None:
    heard: list[Request] = []

    def reply(request: Request) -> bytes | None:
        heard.append(request)
        return told(request) if request.frame < 2 else None

    known = head_intrinsics()
    with replying(reply) as address:
        pictures: Any = Pictures([np.full((480, 640, 3), 90, np.uint8)] * 2, known)
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=60.0)
        source = ServerSource(TASK, settings, pictures)
        before = time.monotonic_ns()
        looks = [source(np.eye(4)), source(np.eye(4))]
        assert source(np.eye(4)) is None  # no picture
    for look in looks:
        assert look is not None and look.estimate.valid.all() and before <= look.time_ns <= time.monotonic_ns()
        np.testing.assert_allclose(look.estimate.T_camera_object[0, 0, :3, 3], [1.0, 0.0, 0.0], atol=1e-12)
    assert [request.frame for request in heard[:2]] == [0, 1] and heard[0].masks is None
    np.testing.assert_allclose(heard[0].K, known.matrix)


def test_a_late_answer_counts_from_where_its_picture_was_taken() -> None:
    def late(request: Request) -> bytes | None:
        time.sleep(0.3 if request.frame == 0 else 0.0)
        return told(request) if request.frame == 0 else None

    with replying(late) as address:
        pictures: Any = Pictures([np.zeros((48, 64, 3), np.uint8)] * 200, head_intrinsics(64, 48))
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=0.05)
        source, look, until = ServerSource(TASK, settings, pictures), None, time.monotonic() + 20.0
        first, turned = np.eye(4), poses.from_rotation(poses.rotation_from_vector([0.0, 0.0, 0.8]))
        assert source(first) is None, "the answer is late"
        while look is None and time.monotonic() < until:
            look = source(turned)
    assert look is not None
    np.testing.assert_array_equal(look.T_odometry_camera, first)
    np.testing.assert_allclose(look.estimate.T_camera_object[0, 0, :3, 3], [1.0, 0.0, 0.0], atol=1e-12)


def test_a_silent_server_gives_no_look() -> None:
    with replying(lambda request: None) as address:
        pictures: Any = Pictures([np.zeros((48, 64, 3), np.uint8)], head_intrinsics(64, 48))
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=0.05)
        assert ServerSource(TASK, settings, pictures)(np.eye(4)) is None


def test_what_a_server_was_asked_before_the_source_forgot_is_not_believed() -> None:
    heard: list[Request] = []

    def reply(request: Request) -> bytes:
        heard.append(request)
        time.sleep(0.5 if request.frame == 0 else 0.0)
        return told(request)

    with replying(reply) as address:
        pictures: Any = Pictures([np.zeros((48, 64, 3), np.uint8)] * 2000, head_intrinsics(64, 48))
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=0.05)
        source, look, until = ServerSource(TASK, settings, pictures), None, time.monotonic() + 20.0
        assert source(np.eye(4)) is None, "the answer is late"
        source.forget()
        while look is None and time.monotonic() < until:
            look = source(np.eye(4))
    assert look is not None and heard[-1].frame > 0 and heard[0].session != heard[-1].session
    assert not heard[0].depth.any(), "LeRobot's depth is not seen from where the picture is"


class Remembers:
    """A source that counts how often it has forgotten."""

    forgotten = 0

    def __call__(self, T_odometry_camera: np.ndarray) -> None:
        """Look at nothing."""

    def forget(self) -> None:
        self.forgotten += 1


def test_who_stands_up_has_not_seen_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Remembers()
    monkeypatch.setattr(pose_process, "make_source", lambda *_: source)
    process = PoseProcess(PoseSettings(source="exact", task="LiftBox", folder=tmp_path, interface="lo"))
    control, found = records.slot(tmp_path, "control"), []
    for mode, since_ns in (
        (Mode.DAMP, 1), (Mode.STAND, 2), (Mode.STAND, 2), (Mode.RUN, 3), (Mode.HOLD, 4), (Mode.STAND, 5)
    ):  # fmt: skip
        control.write(records.record("control", mode=mode, since_ns=since_ns))
        process._look()
        found.append(source.forgotten)
    assert found == [0, 1, 1, 1, 1, 2]


@pytest.mark.parametrize("yaw", [0.2, 1.4, 2.9, -2.0])
def test_of_poses_that_look_the_same_a_camera_tells_the_one_that_policies_know(yaw: float) -> None:
    task = get_task("GraspCube")
    seen, camera = _Seen(task), poses.from_rotation(poses.rotation_from_vector([0.0, 0.0, 0.3]), [0.1, 0.0, 1.2])
    T = poses.from_rotation(poses.rotation_from_vector([0.0, 0.0, yaw]), [0.6, 0.1, 0.8])
    seen.add(0, T, 5)
    look = seen.look(camera, 5)
    assert look is not None
    told = camera @ look.estimate.T_camera_object[0, 0]
    np.testing.assert_allclose(told, nearest_equivalent(T[None], task.objects[0], camera[None])[0], atol=1e-12)


def test_a_look_is_as_old_as_the_object_that_was_seen_last() -> None:
    T = np.tile(np.eye(4), (1, 2, 1, 1))
    valid, inliers = np.array([[False, False]]), np.ones((1, 2))
    never = PoseEstimate(T_camera_object=T, valid=valid, age_s=np.full((1, 2), np.inf), inliers=inliers)
    assert Look.of(never, np.eye(4), 10**9) is None
    look = Look.of(replace(never, age_s=np.array([[0.3, np.inf]])), np.eye(4), 10**9)
    assert look is not None and look.time_ns == 7 * 10**8


def test_sources_that_do_not_exist_or_lack_something_are_refused(tmp_path: Path) -> None:
    def make(source: str) -> PoseSettings:
        return PoseSettings(source=source, task="LiftBox", folder=tmp_path, interface="lo")

    with pytest.raises(UnknownNameError, match="did you mean 'exact'"):
        make("exakt")
    with pytest.raises(RobotError, match="give --tags with --camera"):
        replace(make("apriltag"), camera="{}")
    with pytest.raises(RobotError, match="rgbd with a camera"):
        replace(make("rgbd"), camera="{}")
    with pytest.raises(SceneError, match="number"):
        make("rgbd,bias_mm=much")
    twice = {"id": 1, "size_m": 0.05, "pose": [0, 0, 0, 1, 0, 0, 0]}
    (tmp_path / "tags.json").write_text(json.dumps({"box": [twice, twice]}))
    with pytest.raises(SceneError, match="each id once"):
        read_tags(tmp_path / "tags.json", ["box"])
    (tmp_path / "tags.json").write_text('{"box": []}')
    with pytest.raises(SceneError, match="no tag on box"):
        read_tags(tmp_path / "tags.json", ["box"])
    (tmp_path / "tags.json").write_text('{"box": [{"id": 1, "size_m": 0.05, "pose": [0, 0]}]}')
    with pytest.raises(SceneError, match="tags that cannot be read"):
        read_tags(tmp_path / "tags.json", ["box"])


def picture_of_tag(number: int, size_m: float, T_optical_tag: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return a picture (480, 640, 3) of a printed tag on white paper, drawn by its homography."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side, margin = 400, 100
    paper = np.full((side + 2 * margin, side + 2 * margin), 255, np.uint8)
    drawn = cv2.aruco.generateImageMarker(dictionary, number, side)
    paper[margin:-margin, margin:-margin] = drawn[::-1, ::-1]  # OpenCV draws tags of this family upside down
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
def test_a_tag_in_a_picture_gives_the_pose_of_its_object(turn: float, tmp_path: Path) -> None:
    known = Intrinsics(width=640, height=480, focal=617.0, center_u=319.5, center_v=239.5)
    facing = poses.from_rotation(np.diag([1.0, -1.0, -1.0]), [0.05, -0.03, 0.7])  # its z towards the camera
    T_optical_tag = facing @ poses.from_rotation(poses.rotation_from_vector([0.0, turn, 0.1]))
    numbers = [0.02, 0.03, 0.09, 0.5, 0.5, 0.5, 0.5]
    (tmp_path / "tags.json").write_text(json.dumps({"box": [{"id": 7, "size_m": 0.08, "pose": numbers}]}))
    shown = [picture_of_tag(number, 0.08, T_optical_tag, known.matrix) for number in (8, 7, 8)]
    camera: Any = Pictures(shown, known)
    source = TagSource(TASK, tmp_path / "tags.json", camera)
    turned = poses.from_rotation(poses.rotation_from_vector([0.0, 0.0, 0.2]), [0.3, -0.2, 0.1])
    assert source(np.eye(4)) is None
    look, later = source(np.eye(4)), source(turned)
    assert look is not None and look.estimate.valid.all()
    found = look.estimate.T_camera_object[0, 0]
    expected = T_CAMERA_OPTICAL @ T_optical_tag @ poses.invert(poses.pose(numbers[:3], numbers[3:]))
    expected = nearest_equivalent(expected[None], TASK.objects[0], np.eye(4)[None])[0]
    assert np.linalg.norm(found[:3, 3] - expected[:3, 3]) < 0.01
    assert np.linalg.norm(poses.rotation_vector(found[:3, :3].T @ expected[:3, :3])) < 0.06
    assert later is not None and not later.estimate.valid.any()
    assert abs(later.time_ns - look.time_ns) < 10  # it grows old
    held = turned @ later.estimate.T_camera_object[0, 0]
    np.testing.assert_allclose(held, found, atol=1e-12, err_msg="out of sight it stays where it was, the head turns")
    assert source(np.eye(4)) is None
    camera._pictures.append(np.zeros((480, 640, 3), np.uint8))
    source.forget()
    assert source(np.eye(4)) is None, "it has to be seen again"
