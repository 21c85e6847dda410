"""``demohlm_g1`` with ``backend=dds``: LeRobot's loop drives a simulated robot, through the deployment's controller."""

import time
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from lerobot_demohlm.benchmarks.deployment import RobotProcess
from lerobot_demohlm.devices import DemoHLMG1Config
from lerobot_demohlm.devices.g1 import DemoHLMG1
from tests.helpers.robot import free_domain


@pytest.mark.slow
def test_actions_of_a_loop_move_the_robot_and_silence_holds_it(tmp_path: Path) -> None:
    """Needs a machine that runs in real time."""
    domain = free_domain()
    process = RobotProcess("LiftBox", domain, tmp_path, ["--gantry-s", "1e9"])
    process.wait_for("hangs", 300.0)
    config = DemoHLMG1Config(
        backend="dds", interface="lo", domain=domain, servo_port=process.servos, objects=True, calibration_dir=tmp_path
    )
    robot = DemoHLMG1(config)
    try:
        robot.connect()
        seen = robot.get_observation()
        assert set(seen) == {*observation.STATE_NAMES, *observation.environment_names(robot.task)}
        wanted = command.rest()
        wanted[command.NAMES.index("left_elbow.pos")] += 0.3
        for _ in range(15):
            sent = robot.send_action(dict(zip(command.NAMES, wanted.tolist(), strict=True)))
            time.sleep(0.1)
        assert sent["left_elbow.pos"] == pytest.approx(wanted[command.NAMES.index("left_elbow.pos")])
        after = robot.get_observation()
        assert after["left_elbow.pos"] - seen["left_elbow.pos"] == pytest.approx(0.3, abs=0.08)
        assert np.isfinite(list(after.values())).all()
        time.sleep(0.5)
        deployment = robot._world._deployment  # pyright: ignore
        assert deployment.mode.name == "HOLD" and deployment.reason.startswith("policy silent")
        robot.reset()
        robot.send_action({"base_yaw.vel": 0.0})
        assert deployment.mode.name == "RUN"
    finally:
        if robot.is_connected:
            robot.disconnect()
        counted = process.end()
        process.kill()
    assert counted["violations"] == 0 and counted["executed"] > 100
