"""The name of a process of a deployment -> that process, from its start to its end.

Each process imports the module of what it runs, and not those of the others.
"""

import json
import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.priority import Urgency, hurry
from lerobot_demohlm.reproducibility.processes import end_with_parent, hush_torchcodec

GO = "go"  # a file: everything but the controller is ready


def run_process(name: str, settings: DeploymentSettings, folder: Path) -> None:
    """Be one of the processes of a deployment, until it ends.

    It leaves the terminal's group: what is typed there, and its end, reach the process that started it alone. When that
    ends in whatever way, all others end, the controller braking the motors and the recorder writing what it has.

    Where a process refuses what it was given, it writes why to ``<name>.error`` and ends with exit status 2. Where it
    is ready, it makes ``<name>.ready``.

    Args:
        name: ``control``, ``policy``, ``pose``, ``servos`` or ``recorder``.
        settings: What is deployed.
        folder: Of the slots, and of these files.
    """
    os.setpgid(0, 0)  # not a session of its own: there its priority would count for nothing (Linux's autogroups)
    try:
        _make(name, settings, folder).run()
    except DemoHLMError as error:
        content = {"got": error.got, "expected": error.expected, "remedy": error.remedy}
        (folder / f"{name}.error").write_text(json.dumps(content))
        raise SystemExit(2) from None


def _make(name: str, settings: DeploymentSettings, folder: Path) -> Any:  # noqa: ANN401
    """Make what a process runs, and say that it is ready."""
    if name == "control":
        from lerobot_demohlm.hardware.control_process import ControlProcess, ControlSettings

        signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started it ends it
        parent = multiprocessing.parent_process()
        while not (folder / GO).exists():  # it is loaded, but sends nothing before all others are ready
            if parent is not None and not parent.is_alive():
                raise SystemExit(1)
            time.sleep(0.01)
        hurry(Urgency.CONTROL)
        made: Any = ControlProcess(
            ControlSettings(
                interface=settings.interface,
                folder=folder,
                task=settings.task,
                domain=settings.domain,
                weights=settings.weights,
                servos=settings.servo_port is not None,
                recorded=settings.root is not None,
                policy=settings.policy is not None,
                limits=settings.limits,
                ages=settings.ages,
            )
        )
    else:
        if name == "recorder":
            hush_torchcodec()
        else:
            end_with_parent()
        made = _make_helper(name, settings, folder)
        if name != "recorder":
            hurry(Urgency.CONTROL if name == "servos" else Urgency.HELPER)
    (folder / f"{name}.ready").touch()
    return made


def _make_helper(name: str, settings: DeploymentSettings, folder: Path) -> Any:  # noqa: ANN401
    if name == "policy":
        from lerobot_demohlm.hardware.policy_process import PolicyProcess, PolicySettings

        assert settings.policy is not None  # else there is no such process
        return PolicyProcess(
            PolicySettings(
                path=settings.policy,
                task=settings.task,
                folder=folder,
                device=settings.device,
                region=settings.region,
            )
        )
    if name == "pose":
        from lerobot_demohlm.hardware.pose_process import PoseProcess, PoseSettings

        return PoseProcess(
            PoseSettings(
                source=settings.pose_source,
                task=settings.task,
                folder=folder,
                interface=settings.interface,
                domain=settings.domain,
                tags=settings.tags,
                camera=settings.camera,
                region=settings.region,
            )
        )
    if name == "servos":
        from lerobot_demohlm.hardware.servos import ServoProcess

        assert settings.servo_port is not None  # else there is no such process
        return ServoProcess(folder, settings.servo_port, settings.task)
    from lerobot_demohlm.hardware.recorder import Recorder

    assert settings.root is not None  # else there is no such process
    return Recorder(folder, settings.root)
