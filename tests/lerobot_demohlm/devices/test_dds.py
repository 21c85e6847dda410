"""``demohlm_g1`` with ``backend=dds``: LeRobot's loop drives a simulated robot, through the deployment's controller.

Slow ones need a machine that runs in real time.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import draccus
import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.robots.config import RobotConfig

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks.deployment import RobotProcess
from lerobot_demohlm.devices import DemoHLMG1Config, dds
from lerobot_demohlm.devices.config_g1 import DeviceError
from lerobot_demohlm.devices.dds import DdsRobot
from lerobot_demohlm.devices.g1 import DemoHLMG1
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.motion_switcher import refuse_own_controller
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.hardware.slots import Reading
from tests.helpers.domains import free_domain
from tests.helpers.lerobot import run
from tests.helpers.own_controller import own_controller


class Scripted:
    """A deployment whose robot does, at each look, the next thing of a list: mode, when it was entered, and why."""

    def __init__(self, told: list[tuple[Mode, int, str]], ended: str = "") -> None:
        self._told, self.requests, self.written = told, 0, 0
        self.processes = {name: SimpleNamespace(exitcode=1 if name == ended else None) for name in ("control", "pose")}

    mode = property(lambda self: self._told[0][0])
    reason = property(lambda self: self._told[0][2])
    standing = property(lambda self: self._told[0][0] == Mode.STAND and len(self._told) == 1)

    @property
    def since_ns(self) -> int:
        if len(self._told) > 1:
            self._told.pop(0)
        return self._told[0][1]

    def request(self, mode: Mode) -> None:
        self.requests += 1

    def read(self, name: str) -> Reading:
        value = records.record("control", mode=self.mode, since_ns=1)
        return Reading(value=value, number=1, time_ns=time.monotonic_ns())

    def write_command(self, wanted: np.ndarray, run_ns: int, step: int) -> None:
        self.written += 1

    def check(self) -> None:
        for name, process in self.processes.items():
            if process.exitcode is not None:
                raise RobotError(f"the process {name} ended (1)", "one that stays", "see its message")

    def forget_ended(self) -> None:
        self.processes = {name: each for name, each in self.processes.items() if each.exitcode is None}


def robot_of(deployment: Scripted) -> DdsRobot:
    made: Any = DdsRobot.__new__(DdsRobot)
    made._deployment, made._step, made._told_of_hold = deployment, 1, False
    return made


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds, "BALANCE_S", 0.0)
    monkeypatch.setattr(dds, "ASK_AGAIN_S", 0.0)


_MISSING = [(Mode.DAMP, 1, "not asked to stand yet")] * 2 + [(Mode.DAMP, 1, "will not stand: no servos")] * 2


def test_it_asks_to_stand_again_while_something_is_missing(at_once: None) -> None:
    deployment = Scripted([*_MISSING, (Mode.STAND, 2, "operator"), (Mode.STAND, 2, "operator")])
    robot_of(deployment)._stand()
    assert deployment.requests >= 3


@pytest.mark.parametrize("told", [
    [*_MISSING, (Mode.STAND, 2, "operator"), (Mode.DAMP, 3, "fall: pelvis leans 0.90 rad")],
    [*_MISSING, (Mode.DAMP, 3, "hot motor: 96 Celsius in left_knee")],
    [*_MISSING, (Mode.DAMP, 1, "e-stop by remote")],
], ids=["fall", "between two looks", "e-stop"])  # fmt: skip
def test_it_does_not_ask_to_stand_again_once_the_robot_has_braked(told: list, at_once: None) -> None:
    deployment = Scripted(told)
    reason = told[-1][2]
    with pytest.raises(DeviceError, match=reason.split(":")[0]):
        robot_of(deployment)._stand()
    assert deployment.requests <= len(_MISSING)


def test_a_process_that_ends_leaves_the_robot_to_hold(caplog: pytest.LogCaptureFixture) -> None:
    deployment = Scripted([(Mode.RUN, 1, "operator")], ended="pose")
    robot = robot_of(deployment)
    for _ in range(2):
        robot.send(command.rest())
    assert deployment.written == 2
    assert sum("the process pose ended" in entry.getMessage() for entry in caplog.records) == 1
    with pytest.raises(RobotError, match="the process control ended"):
        robot_of(Scripted([(Mode.RUN, 1, "operator")], ended="control")).send(command.rest())


def test_camera_and_tags_reach_the_deployment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = {"type": "intelrealsense", "serial_number_or_name": "0123456789"}
    given: list[DeploymentSettings] = []

    def refuse(settings: DeploymentSettings) -> None:
        given.append(settings)
        raise RobotError("a test", "its end", "nothing")

    monkeypatch.setattr(dds, "Deployment", refuse)
    monkeypatch.setattr(dds, "refuse_own_controller", lambda interface, domain: None)
    options = [
        "--robot.type=demohlm_g1", "--robot.backend=dds", "--robot.interface=lo", "--robot.pose_source=apriltag",
        f"--robot.camera={json.dumps(camera)}", "--robot.tags=tags.json",
    ]  # fmt: skip
    config = draccus.parse(Wrapped, args=options).robot
    assert isinstance(config, DemoHLMG1Config)
    with pytest.raises(RobotError, match="a test"):
        DdsRobot(config, get_task("LiftBox"))
    assert json.loads(given[0].camera) == camera and given[0].tags == Path("tags.json")


def test_a_robot_that_does_not_run_yet_stands_on(at_once: None, caplog: pytest.LogCaptureFixture) -> None:
    """Nobody presses A: LeRobot's loop goes on, and asks again with its next action. A robot that brakes ends it."""

    class Waiting(Scripted):
        runs = 0

        def run(self, timeout_s: float) -> None:
            self.runs += 1
            raise RobotError(f"{self.mode.name}: will not run: no pose", "RUN", "see what holds it back")

    deployment = Waiting([(Mode.STAND, 1, "operator")])
    robot: Any = robot_of(deployment)
    robot._step, robot._by_remote = 0, False
    for _ in range(2):
        robot.send(command.rest())
    assert (deployment.runs, robot._step) == (2, 0)
    assert sum("does not run yet" in entry.getMessage() for entry in caplog.records) == 2
    braking = Waiting([(Mode.STAND, 1, "operator")])
    robot = robot_of(braking)
    robot._step, robot._by_remote = 0, False
    braking.run = lambda timeout_s: braking._told.__setitem__(0, (Mode.DAMP, 2, "fall")) or Waiting.run(braking, 1.0)
    with pytest.raises(RobotError, match="DAMP"):
        robot.send(command.rest())


def test_a_robot_whose_own_controller_runs_is_refused() -> None:
    pytest.importorskip("cyclonedds")
    domain = free_domain()
    with own_controller(domain) as service:
        with pytest.raises(RobotError, match=r"own controller 'ai'.*deploy --release"):
            DdsRobot(DemoHLMG1Config(backend="dds", interface="lo", domain=domain), get_task("LiftBox"))
        service.name = ""
        refuse_own_controller("lo", domain)


@dataclass
class Wrapped:
    """What LeRobot's commands have around a robot's options."""

    robot: RobotConfig


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
