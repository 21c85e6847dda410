"""``demohlm deploy``."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gym_demohlm.errors import DemoHLMError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default

if TYPE_CHECKING:
    from lerobot_demohlm.hardware.deployment import Deployment


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm deploy``.

    Attributes:
        policy: A pretrained_model directory of `demohlm train` or lerobot-train.
        task: Name of the task that it is to do.
        interface: Network interface of the robot; nothing is sent to any other.
        pose_source: How objects are seen: exact, model, rgbd, remote or apriltag, with the options that
            docs/perception.md has. With --camera it is remote or apriltag.
        servo_port: Serial port of neck and grippers.
        root: Directory of the record; must not exist.
        domain: Of DDS; a real robot's is 0.
        controller: Name, path or hash of the whole-body controller.
        device: Where the policy runs, such as "cuda".
        tags: JSON file of which tag is where on which object, for apriltag with a camera.
        region: Region whose objects there are; those of R4 may have other shapes, and fronts.
        camera: Camera of LeRobot as JSON, such as {"type": "intelrealsense", "serial_number_or_name": "..."}, with a
            calibration where it is no D435, see docs/deployment.md; without one the world of a simulated robot is
            looked at.
        gamepad: Joystick device whose buttons may stop the robot, such as /dev/input/js0.
        release: Release the robot's own controller first; it goes limp and must hang in its gantry.
        hands_free: Stand and run without a key, for a simulated robot on lo only.
        seconds: End after so long.
    """

    policy: Path
    task: str
    interface: str
    pose_source: str = "exact"
    servo_port: Annotated[str | None, default("none")] = None
    root: Annotated[Path | None, default("no record")] = None
    domain: int = 0
    controller: str = "default"
    device: str = "cpu"
    tags: Annotated[Path | None, default("none")] = None
    region: str = DEFAULT_REGION
    camera: Annotated[str | None, default("none")] = None
    gamepad: Annotated[Path | None, default("none")] = None
    release: bool = False
    hands_free: bool = False
    seconds: Annotated[float | None, default("never")] = None


def run(options: Options) -> None:
    """Deploy; the last line on stdout is how it ended, as JSON.

    Raises:
        DemoHLMError: Something was refused; nothing has moved.
    """
    from gym_demohlm.control import controllers
    from lerobot_demohlm.hardware.deployment import Deployment
    from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
    from lerobot_demohlm.hardware.errors import RobotError
    from lerobot_demohlm.hardware.operator_inputs import Gamepad

    if options.hands_free and options.interface != "lo":
        raise RobotError(f"--hands-free on {options.interface}", "lo, a simulated robot", "use the keys")
    settings = DeploymentSettings(
        task=options.task,
        interface=options.interface,
        policy=options.policy,
        pose_source=options.pose_source,
        servo_port=options.servo_port,
        root=options.root,
        domain=options.domain,
        device=options.device,
        weights=controllers.find(options.controller),
        tags=options.tags,
        camera=options.camera or "",
        region=options.region,
    )
    with Deployment(settings, _release(options)) as deployment:
        pad = None if options.gamepad is None else Gamepad(options.gamepad, deployment.request, deployment.estop)
        try:
            _operate(options, deployment)
        finally:
            if pad is not None:
                pad.close()
        ended = {"mode": deployment.mode.name, "reason": deployment.reason}
    print(json.dumps(ended))


def _release(options: Options) -> Callable[[], None]:
    """Return what releases the robot's own controller, which leaves the joints limp; nothing where none runs.

    Raises:
        RobotError: One runs and was not to be released, or the robot does not answer.
    """
    from lerobot_demohlm.hardware.link import Link
    from lerobot_demohlm.hardware.motion_switcher import MotionSwitcher, refuse_own_controller

    if not options.release:
        refuse_own_controller(options.interface, options.domain)
        return lambda: None
    switcher = MotionSwitcher(Link(options.interface, options.domain))
    return switcher.release if switcher.check() else lambda: None


def _operate(options: Options, deployment: "Deployment") -> None:
    """Obey the keys until the operator, or the time, ends it."""
    from lerobot_demohlm.hardware.operator_inputs import obey_key, terminal_keys
    from lerobot_demohlm.hardware.records import Mode

    print("keys: s stand, r run, h hold, d damp, SPACE e-stop, q end", flush=True)
    began, said = time.monotonic(), ""
    if options.hands_free:
        deployment.request(Mode.STAND)
    with terminal_keys() as next_key:
        while options.seconds is None or time.monotonic() - began < options.seconds:
            deployment.note_turn()
            if options.hands_free:
                time.sleep(0.1)
                if deployment.mode == Mode.STAND and _stood_s(deployment) > 5.0:
                    deployment.request(Mode.RUN)
            elif obey_key(next_key(0.1), deployment.request, deployment.estop):
                return
            now = f"{deployment.mode.name}: {deployment.reason}"
            if now != said:
                print(f"{time.monotonic() - began:8.2f} s  {now}", flush=True)
                said = now
            try:
                deployment.check()
            except DemoHLMError as error:
                print(f"{time.monotonic() - began:8.2f} s  {error}", flush=True)
                if deployment.processes["control"].exitcode is not None:
                    raise
                deployment.forget_ended()


def _stood_s(deployment: "Deployment") -> float:
    """Return how long the robot has been in its mode [s]."""
    reading = deployment.read("control")
    return 0.0 if reading is None else 1e-9 * (time.monotonic_ns() - int(reading.value["since_ns"]))
