"""A simulated robot's world, or a real camera's pictures -> looks at the objects, by the package's own eyes.

What looks is ``gym_demohlm.perception`` in either case: its perceivers look at the world that a simulated robot shows;
its tag finder and its pose client look at the pictures of a camera.
"""

import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import Intrinsics
from gym_demohlm.perception.equivalents import steady_equivalent
from gym_demohlm.perception.estimate import UNSEEN, PoseEstimate
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.hardware import world_topic
from lerobot_demohlm.hardware.camera import HeadCamera
from lerobot_demohlm.hardware.link import WORLD, Link

Where = Callable[[int], np.ndarray | None]
"""Tells ``T_odometry_camera`` (4, 4) at a time (``time.monotonic_ns``); None where that is not known."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """One look at the objects of one world.

    Attributes:
        estimate: Where they seem to be, one row.
        T_odometry_camera: (4, 4), where the camera was in whose frame they are.
        time_ns: When one of them was seen last (``time.monotonic_ns``).
    """

    estimate: PoseEstimate
    T_odometry_camera: np.ndarray
    time_ns: int

    @classmethod
    def of(cls, estimate: PoseEstimate, T_odometry_camera: np.ndarray, now_ns: int) -> "Look | None":
        """Return a look that is as old as the object that was seen last; None before any was seen."""
        age_s = float(estimate.age_s.min())
        if not np.isfinite(age_s):
            return None
        return cls(estimate=estimate, T_odometry_camera=T_odometry_camera, time_ns=now_ns - round(1e9 * age_s))


class Source(Protocol):
    """What looks at the objects."""

    def __call__(self, where: Where) -> Look | None:
        """Return the newest look; None where there is no new one.

        Args:
            where: Tells where the head camera was when the robot saw what is looked at.
        """
        ...

    def forget(self) -> None:
        """Forget every object: the robot may have been moved."""
        ...

    def close(self) -> None:
        """Give back what it looks with."""
        ...


class WorldSource:
    """Looks at the world of a simulated robot.

    Args:
        task: The task.
        settings: With which eyes.
        link: The network.
    """

    def __init__(self, task: Task, settings: str | PerceptionSettings, link: Link) -> None:
        self._sim = Simulation(task)
        self._perceiver = make_perceiver(settings, task, 1)
        self._reader = link.reader(WORLD)
        self._episode = -1

    def __call__(self, where: Where) -> Look | None:
        """Return the newest look; None where no new world has come."""
        content, time_ns = self._reader.newest(), time.monotonic_ns()
        T_odometry_camera = where(time_ns)
        if content is None or T_odometry_camera is None:
            return None
        episode, _, physics, mocap = world_topic.unpack(content)
        world_topic.show(self._sim, physics, mocap)
        if episode != self._episode:
            self._episode = episode
            self._perceiver.begin(np.array([0]), [episode])
        return Look.of(self._perceiver.observe(self._sim, np.array([0])), T_odometry_camera, time_ns)

    def forget(self) -> None:
        """Begin anew with the next world."""
        self._episode = -1

    def close(self) -> None:
        """Give back what draws the world."""
        self._perceiver.close()
        self._sim.close()


class _Seen:
    """What was seen of each object, and when; what is not seen now keeps its pose in the frame "odometry".

    Of poses that look the same it tells the one that heads as the camera does. ``rgbd`` and ``exact`` do both. The
    model of errors, by which policies of varied worlds see, does so with what it sees, not with what it holds.
    """

    def __init__(self, task: Task) -> None:
        self._objects = task.objects
        self.forget()

    def forget(self) -> None:
        """Forget every object."""
        count = len(self._objects)
        self._T, self._at = np.tile(np.eye(4), (count, 1, 1)), np.full(count, -1, np.int64)
        self._told: list[np.ndarray | None] = [None] * count

    def add(self, index: int, T_odometry_object: np.ndarray, time_ns: int) -> None:
        """Note where an object was seen."""
        self._T[index], self._at[index] = T_odometry_object, time_ns

    def expected(self, index: int, T_odometry_optical: np.ndarray) -> np.ndarray | None:
        """Return where an object should be in the frame ``optical`` (4, 4); None before it was seen."""
        return None if self._at[index] < 0 else poses.invert(T_odometry_optical) @ self._T[index]

    def look(self, T_odometry_camera: np.ndarray, now_ns: int) -> Look | None:
        """Return what is known, from where the camera was at that time; None before any object was seen."""
        seen = self._at >= 0
        age_s = np.where(seen, 1e-9 * (now_ns - self._at), np.inf)[None]
        valid = self._at[None] == now_ns
        T_camera_odometry = poses.invert(T_odometry_camera)
        T_camera_object = np.tile(poses.pose(UNSEEN), (1, len(self._objects), 1, 1))
        for index in np.flatnonzero(seen):
            told = steady_equivalent(self._T[index], self._objects[index], T_odometry_camera, self._told[index])
            self._told[index], T_camera_object[0, index] = told, T_camera_odometry @ told
        estimate = PoseEstimate(T_camera_object=T_camera_object, valid=valid, age_s=age_s, inliers=valid.astype(float))
        return Look.of(estimate, T_odometry_camera, now_ns)


class TagSource:
    """Looks for AprilTags in a camera's pictures.

    Args:
        task: The task.
        tags: File of tags, see ``gym_demohlm.perception.tag_file``.
        camera: Of the head.

    Raises:
        SceneError: The file cannot be read, or an object has no tag.
    """

    def __init__(self, task: Task, tags: Path, camera: HeadCamera) -> None:
        from gym_demohlm.perception.tag_file import read_tags
        from gym_demohlm.perception.tags import TagFinder

        self._tags = read_tags(tags, [entry.name for entry in task.objects])
        self._camera, self._finder, self._seen = camera, TagFinder(), _Seen(task)
        self._known: Intrinsics | None = None

    def __call__(self, where: Where) -> Look | None:
        """Return the newest look; None before any object was seen, and where no picture comes."""
        import cv2

        from gym_demohlm.perception.camera import whole
        from gym_demohlm.perception.tags import object_pose

        picture = self._camera.picture()
        T_odometry_camera = None if picture is None else where(picture.time_ns)
        if picture is None or T_odometry_camera is None:
            return None
        T_odometry_optical = T_odometry_camera @ self._camera.T_camera_optical
        self._known = self._known or self._camera.intrinsics(picture.image.shape)
        corners = self._finder.corners(cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY), whole(self._known))
        for index, worn in enumerate(self._tags):
            expected = self._seen.expected(index, T_odometry_optical)
            found = object_pose(worn, corners, self._known, expected)
            if found is not None:
                self._seen.add(index, T_odometry_optical @ found[0], picture.time_ns)
        return self._seen.look(T_odometry_camera, picture.time_ns)

    def forget(self) -> None:
        """Forget where each object was seen."""
        self._seen.forget()

    def close(self) -> None:
        """Give back the camera."""
        self._camera.close()


class ServerSource:
    """Sends a camera's pictures to a pose server, which finds the objects in them by itself.

    It is told where the camera is by the robot's odometry. A late answer counts from where the camera was when its
    picture was taken. No depth is sent: LeRobot's cameras give it as seen from another place than the picture.

    Args:
        task: The task.
        settings: ``address`` and ``timeout_s`` are read.
        camera: Of the head.
    """

    def __init__(self, task: Task, settings: PerceptionSettings, camera: HeadCamera) -> None:
        import zmq

        from gym_demohlm.perception.pose_client import PoseClient

        self._task, self._camera, self._seen = task, camera, _Seen(task)
        self._client = PoseClient(zmq.Context(), settings.address, settings.timeout_s)
        self._session, self._frame = uuid.uuid4().hex, 0
        self._asked_ns: int | None = None
        self._taken: dict[int, tuple[int, np.ndarray]] = {}  # when and from where the picture asked about was

    def __call__(self, where: Where) -> Look | None:
        """Return the newest look; None before any object was seen, and where neither picture nor answer comes."""
        from gym_demohlm.perception.wire import Request

        picture = self._camera.picture()
        T_odometry_camera = None if picture is None else where(picture.time_ns)
        if picture is None or T_odometry_camera is None:
            return None
        image, now_ns, before_ns = picture.image, picture.time_ns, self._asked_ns
        self._taken[self._frame], self._asked_ns = (now_ns, T_odometry_camera), now_ns
        told = self._client.look(
            Request(
                session=self._session,
                frame=self._frame,
                task=self._task.name,
                objects=tuple(entry.name for entry in self._task.objects),
                K=self._camera.intrinsics(image.shape).matrix,
                T_odom_optical=T_odometry_camera @ self._camera.T_camera_optical,
                hands={},
                color=image,
                depth=np.zeros(image.shape[:2], np.float32),
                masks=None,
                dt_s=STEP_DT if before_ns is None else 1e-9 * (now_ns - before_ns),
                region=self._task.form,
            )
        )
        self._frame += 1
        taken, asked = self._taken, self._client.asked
        self._taken = {} if asked is None else {asked: taken[asked]}
        if told is None:
            return None
        taken_ns, T_odometry_then = taken[told.request.frame]
        for index, answer in enumerate(told.answers):
            if answer.valid and told.request.session == self._session:
                self._seen.add(index, told.request.T_odom_optical @ answer.T_optical_object, taken_ns)
        return self._seen.look(T_odometry_then, taken_ns)

    def forget(self) -> None:
        """Forget where each object was seen; what the server still says of earlier pictures is not believed."""
        self._seen.forget()
        self._session = uuid.uuid4().hex

    def close(self) -> None:
        """Give back the camera, and the connection to the server."""
        self._client.close()
        self._camera.close()
