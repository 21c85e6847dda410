"""What is deployed, and to where: checked before any process starts."""

from dataclasses import dataclass, field
from pathlib import Path

from gym_demohlm.registry import get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.limits import Ages, Limits
from lerobot_demohlm.hardware.link import DOMAIN, check_interface


@dataclass(frozen=True, kw_only=True)
class DeploymentSettings:
    """What is deployed, and to where.

    Attributes:
        task: Name of the task.
        interface: Of the network.
        policy: A ``pretrained_model`` directory; None where commands come from LeRobot's own loop.
        pose_source: With which eyes, see ``pose_process.PoseSettings``.
        servo_port: Serial port of neck and grippers; None where there are none.
        root: Directory of the record; None for no record.
        domain: Of DDS.
        device: Where the policy runs.
        weights: File of the whole-body controller; the packaged one by default.
        tags: For ``apriltag`` with a camera.
        camera: LeRobot's camera, see ``camera.read_camera``; a simulated robot's world without one.
        region: Whose objects there are: those of R4 may have other shapes, and fronts.
        limits: Of commands and measurements.
        ages: Of the watchdogs.
    """

    task: str
    interface: str
    policy: Path | None
    pose_source: str = "exact"
    servo_port: str | None = None
    root: Path | None = None
    domain: int = DOMAIN
    device: str = "cpu"
    weights: Path | None = None
    tags: Path | None = None
    camera: str = ""
    region: str = DEFAULT_REGION
    limits: Limits = field(default_factory=Limits)
    ages: Ages = field(default_factory=Ages)

    def __post_init__(self) -> None:
        """Check names.

        Raises:
            UnknownNameError: There is no such task, region or pose source.
            RobotError: There is no such interface, the record exists, grippers have no port, or see ``PoseSettings``.
        """
        from lerobot_demohlm.hardware.pose_process import PoseSettings

        task = get_task(self.task)
        check_interface(self.interface)
        PoseSettings(
            source=self.pose_source,
            task=self.task,
            folder=Path(),
            interface=self.interface,
            tags=self.tags,
            camera=self.camera,
            region=self.region,
        )  # checks
        if task.hands == "gripper" and self.servo_port is None:
            raise RobotError(f"{task.name} without grippers", "the serial port of the grippers", "give --servo-port")
        if self.root is not None and self.root.exists():
            raise RobotError(f"the record {self.root}, which exists", "a new path", "choose another --root")
