"""Where objects are -> the slot "pose" at 25 Hz: a process of its own, whose silence the watchdog notices.

``exact`` and ``rgbd`` look at a simulated robot's world: the first asks it, the second draws what a D435 would measure
and tracks the objects in it. ``remote`` takes poses from another program over UDP, ``apriltag`` finds tags in the
images of a camera (see ``apriltag.py``).
"""

import json
import math
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from lerobot_demohlm.hardware import records, world_topic
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import DOMAIN, WORLD, Link
from lerobot_demohlm.hardware.look import Look

SOURCES = ("exact", "rgbd", "remote", "apriltag")
PERIOD_S = 0.04
REMOTE_PORT = 8025


@dataclass(frozen=True, kw_only=True)
class PoseSettings:
    """Where poses come from.

    Attributes:
        source: One of ``SOURCES``.
        task: Name of the task.
        folder: Of the slots.
        interface: Of the network.
        domain: Of DDS.
        tags: File that says which tag is where on which object, for ``apriltag``.
        camera: LeRobot's camera, as JSON of its configuration, for ``apriltag``.
        port: For ``remote``.
    """

    source: str
    task: str
    folder: Path
    interface: str
    domain: int = DOMAIN
    tags: Path | None = None
    camera: str = ""
    port: int = REMOTE_PORT

    def __post_init__(self) -> None:
        """Check source and what it needs.

        Raises:
            UnknownNameError: There is no such source.
            RobotError: ``apriltag`` without tags.
        """
        if self.source not in SOURCES:
            raise UnknownNameError("pose source", self.source, SOURCES)
        if self.source == "apriltag" and self.tags is None:
            raise RobotError("apriltag without tags", "a file that says where tags are", "give --tags")


Source = Callable[[], Look | None]
"""Returns the newest look; None where there is no new one."""


class WorldSource:
    """Looks at the world of a simulated robot.

    Args:
        task: The task.
        kind: "exact" or "rgbd".
        link: The network.
    """

    def __init__(self, task: Task, kind: str, link: Link) -> None:
        self._sim = Simulation(task)
        self._perceiver = make_perceiver(kind, task, 1)
        self._reader = link.reader(WORLD)
        self._episode = -1

    def __call__(self) -> Look | None:
        """Return the newest look; None where no new world has come."""
        content = self._reader.newest()
        if content is None:
            return None
        time_ns = time.monotonic_ns()
        episode, _, physics, mocap = world_topic.unpack(content)
        world_topic.show(self._sim, physics, mocap)
        if episode != self._episode:
            self._episode = episode
            self._perceiver.begin(np.array([0]), [episode])
        return _look(self._perceiver.observe(self._sim, np.array([0])), time_ns)


class RemoteSource:
    """Takes poses from another program: JSON over UDP, one datagram a look.

    ``{"age_s": 0.02, "objects": {"box": [x, y, z, qw, qx, qy, qz]}}``, in the frame ``head_camera`` (x forward, y left,
    z up). An object that is left out was not seen.

    Args:
        task: The task.
        interface: Of the network, whose address is listened at.
        port: To listen at.
    """

    def __init__(self, task: Task, interface: str, port: int) -> None:
        self._names = [entry.name for entry in task.objects]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
        self._socket.bind(("", port))
        self._socket.setblocking(False)
        self._known: dict[str, tuple[np.ndarray, int]] = {}

    def __call__(self) -> Look | None:
        """Return the newest look; None where none has come, or none that can be read."""
        found = None
        while True:
            try:
                content = self._socket.recv(65536)
            except BlockingIOError:
                return found
            found = self._read(content) or found

    def _read(self, content: bytes) -> Look | None:
        try:
            message = json.loads(content)
            age = float(message.get("age_s", 0.0))
            numbers = {name: np.array(message["objects"][name], float) for name in message["objects"]}
        except (ValueError, TypeError, KeyError, AttributeError):
            return None
        sound = all(
            each.shape == (7,) and np.isfinite(each).all() and abs(each[3:] @ each[3:] - 1.0) < 0.02
            for each in numbers.values()
        )
        if not sound or not 0.0 <= age < 10.0 or not numbers.keys() <= set(self._names):
            return None
        now = time.monotonic_ns() - round(1e9 * age)
        for name, each in numbers.items():
            self._known[name] = poses.pose(each[:3], each[3:] / math.sqrt(each[3:] @ each[3:])), now
        if len(self._known) < len(self._names):
            return None
        return Look(
            T_camera_object=np.stack([self._known[name][0] for name in self._names]),
            valid=np.array([name in numbers for name in self._names]),
            age_s=np.array([1e-9 * (now - self._known[name][1]) for name in self._names]),
            time_ns=now,
        )


class PoseProcess:
    """Keeps the slot "pose" new.

    Args:
        settings: Where poses come from.

    Raises:
        RobotError: The source cannot be opened.
    """

    def __init__(self, settings: PoseSettings) -> None:
        task = get_task(settings.task)
        self._slot, self._stop = records.slot(settings.folder, "pose"), False
        self._source = make_source(settings, task)

    def run(self) -> None:
        """Look until a signal asks for the end."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        due = time.monotonic()
        while not self._stop:
            began = time.perf_counter()
            look = self._source()
            if look is not None:
                self._slot.write(_record(look, time.perf_counter() - began), look.time_ns)
            due = max(due + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))


def make_source(settings: PoseSettings, task: Task) -> Source:
    """Return what finds poses."""
    if settings.source == "remote":
        return RemoteSource(task, settings.interface, settings.port)
    if settings.source == "apriltag":
        from lerobot_demohlm.hardware.apriltag import TagSource  # loads OpenCV

        assert settings.tags is not None  # checked by PoseSettings
        return TagSource(task, settings.tags, settings.camera)
    return WorldSource(task, settings.source, Link(settings.interface, settings.domain))


def _look(estimate: PoseEstimate, time_ns: int) -> Look:
    return Look(
        T_camera_object=estimate.T_camera_object[0], valid=estimate.valid[0], age_s=estimate.age_s[0], time_ns=time_ns
    )


def _record(look: Look, looking_s: float) -> np.void:
    count = len(look.valid)
    value = np.zeros((), records.RECORDS["pose"])
    value["T_camera_object"][:] = np.eye(4)
    value["T_camera_object"][:count], value["valid"][:count] = look.T_camera_object, look.valid
    value["age_s"][:count], value["looking_s"] = look.age_s, looking_s
    return value[()]  # pyright: ignore[reportReturnType]
