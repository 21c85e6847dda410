"""``demohlm_g1`` with ``backend=dds``: LeRobot's loop drives a simulated robot, through the deployment's controller.

All need a machine that runs in real time.
"""

import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks.deployment import RobotProcess
from lerobot_demohlm.devices import DemoHLMG1Config
from lerobot_demohlm.devices.g1 import DemoHLMG1
from tests.helpers.lerobot import run
from tests.helpers.robot import free_domain


@pytest.mark.slow
def test_actions_of_a_loop_move_the_robot_and_silence_holds_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
        for _ in range(2):
            robot.send_action({"base_yaw.vel": 0.0})
        assert deployment.mode.name == "HOLD"
        assert [entry.getMessage().partition(" (policy silent")[0] for entry in caplog.records].count(
            "the robot holds"
        ) == 1
        robot.reset()
        robot.send_action({"base_yaw.vel": 0.0})
        assert deployment.mode.name == "RUN"
    finally:
        if robot.is_connected:
            robot.disconnect()
        counted = process.end()
        process.kill()
    assert counted["violations"] == 0 and counted["executed"] > 100


@pytest.mark.slow
def test_lerobots_commands_record_replay_and_roll_out(tmp_path: Path) -> None:
    """The scripted operator sees the robot through its mirror alone, and has it lift the box."""
    domain = free_domain()
    process = RobotProcess("LiftBox", domain, tmp_path, ["--near"])
    process.wait_for("hangs", 300.0)
    robot = [
        "--robot.type=demohlm_g1", "--robot.task=LiftBox", "--robot.backend=dds", "--robot.interface=lo",
        f"--robot.domain={domain}", f"--robot.servo_port={process.servos}", "--robot.objects=true",
    ]  # fmt: skip
    root = tmp_path / "recorded"
    of_dataset = ["--dataset.repo_id=local/recorded", f"--dataset.root={root}"]
    try:
        run(
            tmp_path, "lerobot-record", *robot, "--teleop.type=demohlm_script", *of_dataset,
            "--dataset.single_task=Lift the box", "--dataset.num_episodes=1", "--dataset.fps=10",
            "--dataset.episode_time_s=7", "--dataset.reset_time_s=0", "--dataset.push_to_hub=false",
            "--play_sounds=false",
        )  # fmt: skip
        table = pq.read_table(root / "data")
        states, actions = np.array(table["observation.state"].to_pylist()), np.array(table["action"].to_pylist())
        names = observation.STATE_NAMES + observation.environment_names(get_task("LiftBox"))
        assert states.shape[1] == len(names) and np.isfinite(states).all()
        arms = [names.index(name) for name in command.NAMES[command.ARMS]]
        assert np.abs(states[:, arms] - actions[:, command.ARMS]).mean() < 0.1
        assert [event["outcome"] for event in process.events if event["event"] == "episode"][:1] == ["success"]
        run(tmp_path, "lerobot-replay", *robot, *of_dataset, "--dataset.episode=0", "--play_sounds=false")
        run(
            tmp_path, "lerobot-train", *of_dataset, "--policy.type=chunked_mlp", "--policy.device=cpu",
            "--policy.push_to_hub=false", f"--output_dir={tmp_path / 'trained'}", "--steps=20", "--batch_size=8",
            "--num_workers=0", "--save_freq=20",
        )  # fmt: skip
        policy = tmp_path / "trained" / "checkpoints" / "last" / "pretrained_model"
        run(
            tmp_path, "lerobot-rollout", *robot, f"--policy.path={policy}", "--policy.device=cpu",
            "--strategy.type=base", "--fps=10", "--duration=3", "--task=Lift the box", "--play_sounds=false",
            "--return_to_initial_position=false",
        )  # fmt: skip
    finally:
        counted = process.end()
        process.kill()
    assert counted["violations"] == 0 and counted["executed"] > 300
