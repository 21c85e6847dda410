"""Options of the robot ``demohlm_g1``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.robots.config import RobotConfig

from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import get_task


class DeviceError(DemoHLMError):
    """A device with options that do not fit, or that was asked for something while it was not connected."""


@RobotConfig.register_subclass("demohlm_g1")
@dataclass(kw_only=True)
class DemoHLMG1Config(RobotConfig):
    """The Unitree G1 of this project.

    Attributes:
        task: Whose world it is in.
        backend: ``sim``, a world in this process; or ``dds``, a robot at the other end of a network, real or simulated.
        pace: ``clock``: the world runs in real time and takes the newest action at 10 Hz. ``step``: each action is one
            step of 0.1 s, whatever time passes between them, so that the same actions give the same bits.
        region: From which each episode's objects are drawn.
        seed: Of these draws.
        spread: Share of the region's offsets that is used; the robot begins where the scripted operator would stand.
        objects: Whether observations hold the objects' poses in the camera frame, behind the robot's own state.
        interface: Network interface of the robot, for ``dds``; nothing is sent to any other.
        domain: Of DDS; a real robot's is 0.
        pose_source: Where objects are, for ``dds``: see ``demohlm deploy``.
        servo_port: Serial port of neck and grippers, for ``dds``.
        camera: LeRobot's camera on the head, for ``dds``, as ``--camera`` of ``demohlm deploy``; a simulated robot's
            world is looked at without one.
        tags: JSON file of which tag is where on which object, for ``apriltag`` with a camera.
    """

    task: str = "LiftBox"
    backend: str = "sim"
    pace: str = "clock"
    region: str = "R1"
    seed: int = 0
    spread: float = 0.2
    objects: bool = False
    interface: str = ""
    domain: int = 0
    pose_source: str = "exact"
    servo_port: str | None = None
    camera: dict[str, Any] | None = None
    tags: Path | None = None

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            UnknownNameError: There is no such task or region.
            DeviceError: A backend or pace that does not exist, or no interface for ``dds``.
        """
        super().__post_init__()
        get_task(self.task).region(self.region)
        if self.backend not in ("sim", "dds"):
            raise DeviceError(f"backend {self.backend!r}", "sim or dds", "choose another --robot.backend")
        if self.backend == "dds" and not self.interface:
            raise DeviceError("backend dds without an interface", "one", "name it with --robot.interface")
        if self.pace not in ("clock", "step"):
            raise DeviceError(f"pace {self.pace!r}", "clock or step", "choose another --robot.pace")
