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
from gym_demohlm.perception.camera import T_CAMERA_OPTICAL, T_OPTICAL_CAMERA, Intrinsics, head_intrinsics
from gym_demohlm.perception.equivalents import nearest_equivalent
from gym_demohlm.perception.estimate import UNSEEN, PoseEstimate
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.perception.tag_file import read_tags
from gym_demohlm.perception.wire import Request
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.hardware import pose_process, records, robot_observation, world_topic
from lerobot_demohlm.hardware.camera import Picture
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import WORLD, Link
from lerobot_demohlm.hardware.odometry import odometry_camera
from lerobot_demohlm.hardware.pose_process import PoseProcess, PoseSettings, _record
from lerobot_demohlm.hardware.pose_sources import Look, ServerSource, TagSource, Where, WorldSource, _Seen
from lerobot_demohlm.hardware.records import Mode
from tests.helpers.pose_servers import replying, told

TASK = get_task("LiftBox")


def at(T_odometry_camera: np.ndarray) -> Where:
    """Return a head camera that rests."""
    return lambda _: T_odometry_camera


HERE = at(np.eye(4))
CALIBRATED = json.dumps(
    {"type": "opencv", "index_or_path": 0, "calibration": {"pose": [0, 0, 0, 1, 0, 0, 0], "focal_px": 600}}
)


def test_exact_poses_of_another_processes_world_are_those_of_the_environment(link: Link) -> None:
    sim = Simulation(TASK)
    for _ in range(4):
        sim.step(command.rest()[None])
    source, writer = WorldSource(TASK, "exact", link), link.writer(WORLD)
    snapshot, look, until = sim.snapshot(), None, time.monotonic() + 20.0
    state = records.record("state", T_odometry_torso=np.eye(4))
    camera = odometry_camera(state, None)
    assert source(at(camera)) is None
    while look is None and time.monotonic() < until:
        writer.send(world_topic.pack(0, 0.4, snapshot["physics"][0], snapshot["mocap"][0]))
        time.sleep(0.02)
        look = source(at(camera))
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
    """A camera that shows the pictures that it is given, then none; taken now, or at times that are given."""

    def __init__(
        self,
        pictures: list[np.ndarray],
        known: Intrinsics,
        lens: np.ndarray | None = None,
        times: list[int] | None = None,
    ) -> None:
        self._pictures, self._known, self._times = pictures, known, times
        self.T_camera_optical = (np.eye(4) if lens is None else lens) @ T_CAMERA_OPTICAL

    def picture(self) -> Picture | None:
        if not self._pictures:
            return None
        time_ns = self._times.pop(0) if self._times else time.monotonic_ns()
        return Picture(image=self._pictures.pop(0), time_ns=time_ns)

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
        looks = [source(HERE), source(HERE)]
        assert source(HERE) is None  # no picture
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
        assert source(at(first)) is None, "the answer is late"
        while look is None and time.monotonic() < until:
            look = source(at(turned))
    assert look is not None
    np.testing.assert_array_equal(look.T_odometry_camera, first)
    np.testing.assert_allclose(look.estimate.T_camera_object[0, 0, :3, 3], [1.0, 0.0, 0.0], atol=1e-12)


def test_a_silent_server_gives_no_look() -> None:
    with replying(lambda request: None) as address:
        pictures: Any = Pictures([np.zeros((48, 64, 3), np.uint8)], head_intrinsics(64, 48))
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=0.05)
        assert ServerSource(TASK, settings, pictures)(HERE) is None


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
        assert source(HERE) is None, "the answer is late"
        source.forget()
        while look is None and time.monotonic() < until:
            look = source(HERE)
    assert look is not None and heard[-1].frame > 0 and heard[0].session != heard[-1].session
    assert not heard[0].depth.any(), "LeRobot's depth is not seen from where the picture is"


class Remembers:
    """A source that counts how often it has forgotten."""

    forgotten = 0

    def __call__(self, where: Where) -> None:
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
    with pytest.raises(RobotError, match=r"lens nobody knows.*calibration"):
        replace(make("remote"), camera='{"type": "opencv", "index_or_path": 0}')
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
    assert source(HERE) is None
    look, later = source(HERE), source(at(turned))
    assert look is not None and look.estimate.valid.all()
    found = look.estimate.T_camera_object[0, 0]
    expected = T_CAMERA_OPTICAL @ T_optical_tag @ poses.invert(poses.pose(numbers[:3], numbers[3:]))
    expected = nearest_equivalent(expected[None], TASK.objects[0], np.eye(4)[None])[0]
    assert np.linalg.norm(found[:3, 3] - expected[:3, 3]) < 0.01
    assert np.linalg.norm(poses.rotation_vector(found[:3, :3].T @ expected[:3, :3])) < 0.06
    assert later is not None and not later.estimate.valid.any()
    assert look.time_ns == pytest.approx(later.time_ns, abs=10)  # it grows old
    held = turned @ later.estimate.T_camera_object[0, 0]
    np.testing.assert_allclose(held, found, atol=1e-12, err_msg="out of sight it stays where it was, the head turns")
    assert source(HERE) is None
    camera._pictures.append(np.zeros((480, 640, 3), np.uint8))
    source.forget()
    assert source(HERE) is None, "it has to be seen again"


KNOWN = Intrinsics(width=640, height=480, focal=617.0, center_u=319.5, center_v=239.5)
T_CAMERA_TAG = (
    T_CAMERA_OPTICAL
    @ poses.from_rotation(np.diag([1.0, -1.0, -1.0]), [0.05, -0.03, 0.8])
    @ poses.from_rotation(poses.rotation_from_vector([0.0, 0.35, 0.1]))
)


def tags_file(folder: Path, **ids: int) -> Path:
    """Write a file of tags that sit at their objects' origins; returns its path."""
    tags = {name: [{"id": number, "size_m": 0.08, "pose": [0, 0, 0, 1, 0, 0, 0]}] for name, number in ids.items()}
    (folder / "tags.json").write_text(json.dumps(tags))
    return folder / "tags.json"


def shown(T_camera_tag: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Return a picture of tag 7 by its place in the frame ``head_camera``, through a lens in that frame."""
    return picture_of_tag(7, 0.08, T_OPTICAL_CAMERA @ poses.invert(lens) @ T_camera_tag, KNOWN.matrix)


@pytest.mark.parametrize("numbers", [[0.0, 0.0325, 0.0, 1, 0, 0, 0], [-0.01, -0.02, 0.03, 0.99, 0.02, -0.05, 0.1]])
def test_wherever_the_lens_is_poses_are_those_in_the_frame_of_the_head_camera(
    numbers: list[float], tmp_path: Path
) -> None:
    lens = poses.pose(numbers[:3], np.array(numbers[3:]) / np.linalg.norm(numbers[3:]))
    camera: Any = Pictures([shown(T_CAMERA_TAG, lens)], KNOWN, lens)
    look = TagSource(TASK, tags_file(tmp_path, box=7), camera)(HERE)
    assert look is not None
    assert np.linalg.norm(look.estimate.T_camera_object[0, 0, :3, 3] - T_CAMERA_TAG[:3, 3]) < 0.005

    asked: list[Request] = []

    def reply(request: Request) -> bytes:
        asked.append(request)
        return told(request)

    with replying(reply) as address:
        pictures: Any = Pictures([np.zeros((48, 64, 3), np.uint8)], head_intrinsics(64, 48), lens)
        settings = PerceptionSettings(source="remote", masks="server", address=address, timeout_s=60.0)
        look = ServerSource(TASK, settings, pictures)(HERE)
    assert look is not None
    ahead = poses.transform(lens, np.array([[1.0, 0.0, 0.0]]))[0]  # 1 m before the lens
    np.testing.assert_allclose(look.estimate.T_camera_object[0, 0, :3, 3], ahead, atol=1e-12)
    np.testing.assert_allclose(asked[0].T_odom_optical, lens @ T_CAMERA_OPTICAL, atol=1e-12)


def test_a_picture_counts_from_where_the_camera_was_when_it_was_taken(tmp_path: Path) -> None:
    def where(time_ns: int) -> np.ndarray | None:
        """Return a head that turns by 1 rad/s; before it was measured nobody knows."""
        return None if time_ns < 0 else poses.planar(0.0, 0.0, 1e-9 * time_ns)

    times = [-1, 0, 60_000_000, 150_000_000]
    pictures = [shown(poses.invert(poses.planar(0.0, 0.0, 1e-9 * max(t, 0))) @ T_CAMERA_TAG, np.eye(4)) for t in times]
    camera: Any = Pictures(pictures, KNOWN, times=times.copy())
    source = TagSource(TASK, tags_file(tmp_path, box=7), camera)
    assert source(where) is None
    for time_ns in times[1:]:
        look = source(where)
        assert look is not None and look.time_ns == time_ns
        found = look.T_odometry_camera @ look.estimate.T_camera_object[0, 0]
        assert np.linalg.norm(found[:3, 3] - T_CAMERA_TAG[:3, 3]) < 0.005


def test_a_look_needs_one_object_and_the_others_are_unseen(tmp_path: Path) -> None:
    """So a neck that needs the bar alone finds it, and a policy observes what the environment would show."""
    task = get_task("PushCart")
    camera: Any = Pictures([shown(T_CAMERA_TAG, np.eye(4))], KNOWN)
    look = TagSource(task, tags_file(tmp_path, bar=7, cart=8), camera)(HERE)
    assert look is not None
    assert look.estimate.valid.tolist() == [[True, False]]
    assert look.estimate.age_s.tolist() == [[0.0, np.inf]]
    record = _record(look, 0.0)
    turned = records.record("state", T_odometry_torso=poses.planar(0.3, 0.1, 0.7))
    seen = robot_observation.objects(record, turned, None)
    np.testing.assert_array_equal(seen[1], poses.pose(UNSEEN))
    there = odometry_camera(turned, None) @ seen[0]
    np.testing.assert_allclose(there, look.estimate.T_camera_object[0, 0], atol=1e-12)


@pytest.mark.parametrize("name", ["GraspCube", "LiftBox"])
def test_in_r4_a_front_stays_where_it_is(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = []
    monkeypatch.setattr(pose_process, "make_source", lambda _, task: tasks.append(task))
    settings = PoseSettings(source="remote", task=name, folder=tmp_path, interface="lo", camera=CALIBRATED)
    for each in (settings, replace(settings, region="R4")):
        PoseProcess(each)
    plain, wide = tasks
    T, yaws = poses.planar(0.8, 0.0, np.radians(80.0)), []
    for task in (plain, wide):
        seen = _Seen(task)
        seen.add(0, T, 1)
        look = seen.look(np.eye(4), 1)
        assert look is not None
        yaws.append(float(np.degrees(poses.yaw(look.estimate.T_camera_object[0, 0]))))
    assert abs(yaws[0]) <= 45.0 + 1e-9 and yaws[1] == pytest.approx(80.0)


def test_a_region_that_a_simulated_world_does_not_show_is_refused(tmp_path: Path) -> None:
    settings = PoseSettings(source="exact", task="LiftBox", folder=tmp_path, interface="lo")
    with pytest.raises(RobotError, match=r"plain shapes.*give --camera"):
        replace(settings, region="R4")
    with pytest.raises(UnknownNameError, match="R9"):
        replace(settings, region="R9")
    replace(settings, region="R1")
