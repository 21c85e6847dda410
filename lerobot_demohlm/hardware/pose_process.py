"""Where objects are -> the slot "pose" at 25 Hz: a process of its own, whose silence the watchdog notices.

Without a camera the source looks at a simulated robot's world: ``exact`` asks it, and the others see what
``gym_demohlm.perception`` draws of it. With a camera ``apriltag`` finds tags in its pictures, and ``remote`` sends them
to a pose server. The slot is as old as the object that was seen last.
"""

import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION, Task
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.camera import HeadCamera, read_camera
from lerobot_demohlm.hardware.camera_path import CameraPath
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import DOMAIN, Link
from lerobot_demohlm.hardware.pose_sources import Look, ServerSource, Source, TagSource, WorldSource
from lerobot_demohlm.hardware.records import Mode

WITH_CAMERA = ("apriltag", "remote")
PERIOD_S = 0.04


@dataclass(frozen=True, kw_only=True)
class PoseSettings:
    """Where poses come from.

    Attributes:
        source: With which eyes, see ``PerceptionSettings.read``: ``rgbd,camera_error=1``.
        task: Name of the task.
        folder: Of the slots.
        interface: Of the network.
        domain: Of DDS.
        tags: File that says which tag is where on which object, for ``apriltag`` with a camera.
        camera: LeRobot's camera, see ``camera.read_camera``; a simulated robot's world without one.
        region: Whose objects there are: those of R4 may have other shapes, and fronts.
    """

    source: str
    task: str
    folder: Path
    interface: str
    domain: int = DOMAIN
    tags: Path | None = None
    camera: str = ""
    region: str = DEFAULT_REGION

    def __post_init__(self) -> None:
        """Check source and what it needs.

        Raises:
            UnknownNameError: There is no such source, task or region.
            SceneError: An option of it is out of range.
            RobotError: A source that cannot use a camera has one, a file of tags and a camera do not come together, a
                camera does not say how it sees, or a simulated robot's world has other shapes than the region.
        """
        source = PerceptionSettings.read(self.source).source
        if self.camera and source not in WITH_CAMERA:
            raise RobotError(f"{source} with a camera", " or ".join(WITH_CAMERA), "choose another --pose-source")
        if (source == "apriltag" and bool(self.camera)) != (self.tags is not None):
            got = (
                "apriltag with a camera and without tags" if self.tags is None else "tags without apriltag and a camera"
            )
            raise RobotError(got, "both: drawn objects wear tags of their own", "give --tags with --camera, or neither")
        form = get_task(self.task).at(self.region).form
        if self.camera:
            read_camera(self.camera)
        elif form:
            raise RobotError(
                f"{self.region} of {self.task} without a camera: a simulated robot's world has the plain shapes",
                "a real camera, or another region", "give --camera, or leave --region out",
            )  # fmt: skip


class PoseProcess:
    """Keeps the slot "pose" new.

    Args:
        settings: Where poses come from.

    Raises:
        RobotError: The source cannot be opened.
    """

    def __init__(self, settings: PoseSettings) -> None:
        task = get_task(settings.task).at(settings.region)
        self._slots = {name: records.slot(settings.folder, name) for name in ("pose", "control")}
        self._path = CameraPath(*(records.slot(settings.folder, name) for name in ("state", "servos")))
        self._stop, self._stood_ns = False, 0
        self._source = make_source(settings, task)

    def run(self) -> None:
        """Look until a signal asks for the end."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        due = time.monotonic()
        try:
            with self._path:
                while not self._stop:
                    self._look()
                    due = max(due + PERIOD_S, time.monotonic())
                    time.sleep(max(0.0, due - time.monotonic()))
        finally:
            self._source.close()

    def _look(self) -> None:
        """Look once; a robot that stands up may have been moved, and knows no object."""
        control = self._slots["control"].read()
        if control is not None and int(control.value["mode"]) == Mode.STAND:
            if int(control.value["since_ns"]) != self._stood_ns:
                self._source.forget()
            self._stood_ns = int(control.value["since_ns"])
        began = time.perf_counter()
        look = self._source(self._path.at)
        if look is not None:
            self._slots["pose"].write(_record(look, time.perf_counter() - began), look.time_ns)


def make_source(settings: PoseSettings, task: Task) -> Source:
    """Return what finds poses."""
    eyes = PerceptionSettings.read(settings.source)
    if not settings.camera:
        return WorldSource(task, eyes, Link(settings.interface, settings.domain))
    camera = HeadCamera(settings.camera)
    if eyes.source == "remote":
        return ServerSource(task, eyes, camera)
    assert settings.tags is not None  # checked by PoseSettings
    return TagSource(task, settings.tags, camera)


def _record(look: Look, looking_s: float) -> np.void:
    seen = look.estimate
    count = seen.valid.shape[1]
    value = np.zeros((), records.RECORDS["pose"])
    value["T_camera_object"][:], value["T_odometry_camera"] = np.eye(4), look.T_odometry_camera
    value["T_camera_object"][:count], value["valid"][:count] = seen.T_camera_object[0], seen.valid[0]
    value["age_s"][:count], value["looking_s"] = seen.age_s[0], looking_s
    return value[()]  # pyright: ignore[reportReturnType]
