"""Processes, real DDS and a simulated robot: what is refused before anything moves, kills, watchdogs, e-stops.

Unmarked tests hold on a machine of any speed; those about times are slow ones.
"""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gym_demohlm.control import command, controllers
from gym_demohlm.errors import DemoHLMError, UnknownNameError
from lerobot_demohlm.benchmarks.deployment import RobotProcess
from lerobot_demohlm.cli import deploy, main
from lerobot_demohlm.evaluation.loaded_policy import policy_hash
from lerobot_demohlm.hardware import deployment as deployments
from lerobot_demohlm.hardware import policy_process, pose_process, recorder
from lerobot_demohlm.hardware.deployment import FACTS, OPERATOR_S, Deployment, _identify
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.faults import Fault, Faults
from lerobot_demohlm.hardware.layout import LowCmd
from lerobot_demohlm.hardware.limits import Ages
from lerobot_demohlm.hardware.link import LOW_CMD, Link
from lerobot_demohlm.hardware.processes import GO, _make_helper
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.reports.explain.deployment_page import explain_deployment
from tests.helpers.checkpoints import save_policy
from tests.helpers.domains import free_domain
from tests.helpers.own_controller import own_controller
from tests.helpers.paths import REPOSITORY
from tests.helpers.robot import until

LONG = Ages(**dict.fromkeys((field.name for field in dataclasses.fields(Ages)), 1e9))  # no watchdog: any machine


def deployed(robot: RobotProcess, domain: int, **changes: object) -> DeploymentSettings:
    settings = DeploymentSettings(task="LiftBox", interface="lo", policy=None, domain=domain, servo_port=robot.servos)
    return dataclasses.replace(settings, **changes)  # pyright: ignore[reportArgumentType]


def test_a_deployment_only_brakes_until_it_is_asked_to_stand(
    hanging: tuple[RobotProcess, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the first command to the kill of its controller; a second controller is refused, and so is a check."""
    robot, domain = hanging
    with Deployment(deployed(robot, domain, root=tmp_path / "record", ages=LONG)) as deployment:
        until(lambda: deployment.read("state") is not None, 60.0)
        assert deployment.mode == Mode.DAMP and not deployment.standing
        facts = json.loads((tmp_path / "record" / FACTS).read_text())
        assert facts["task"] == "LiftBox" and facts["mode"] is None, "it can be read whatever ends the deployment"
        with pytest.raises(RobotError, match="a controller on lo already"):
            Deployment(deployed(robot, domain))
        assert main(["robot-check", "--interface", "lo", "--domain", str(domain), "--seconds", "1"]) == 1
        said = capsys.readouterr().out
        assert "commands of another controller; stop it" in said and '"mode_machine": 5' in said
        control = deployment.processes["control"]
        assert control.pid is not None
        os.kill(control.pid, signal.SIGKILL)
        control.join(10.0)
        until(lambda: any(event["event"] == "damped" for event in robot.events), 60.0)
        with pytest.raises(RobotError, match="the process control ended"):
            deployment.check()
    assert json.loads((tmp_path / "record" / FACTS).read_text())["mode"] == "DAMP"
    (tmp_path / "record" / FACTS).write_text(json.dumps(facts))
    _, short = explain_deployment(tmp_path / "record")
    assert short["ended"].startswith("DAMP: ") and "its end is not recorded" in short["ended"]
    counted = robot.end()
    assert counted["executed"] > 0 and counted["violations"] == 0 and counted["bad_crc"] == 0
    rows = recorder.read(tmp_path / "record")
    assert set(rows["control.mode"].to_pylist()) == {Mode.DAMP}
    assert not any(any(kp) for kp in rows["control.kp"].to_pylist())
    assert all(min(kd) > 0.0 for kd in rows["control.kd"].to_pylist()), "it brakes, always"


def test_a_foreign_controller_is_heard_and_refused(hanging: tuple[RobotProcess, int]) -> None:
    robot, domain = hanging
    message, stop = LowCmd(), threading.Event()
    message.seal()

    def send() -> None:
        with Link("lo", domain) as link:
            foreign = link._writer(LOW_CMD)
            while not stop.wait(0.02):
                foreign.send(message.to_bytes())

    thread = threading.Thread(target=send)
    thread.start()
    try:
        with pytest.raises(RobotError, match="commands of another controller on lo"):
            Deployment(deployed(robot, domain))
    finally:
        stop.set()
        thread.join()


@pytest.mark.slow
def test_policies_that_do_not_fit_are_refused_before_anything_is_sent(
    hanging: tuple[RobotProcess, int], tmp_path: Path
) -> None:
    robot, domain = hanging
    other_features, other_hands = save_policy(tmp_path / "other", state_size=60), save_policy(tmp_path / "hands")
    (other_hands / "train_config.json").write_text('{"env": {"task": "GraspCube"}}')
    with Link("lo", domain) as link:
        heard, released = link.reader(LOW_CMD), []
        with pytest.raises(DemoHLMError, match=r"observation.state \(60,\)"):
            Deployment(deployed(robot, domain, policy=other_features), lambda: released.append(domain))
        assert heard.newest() is None and not released, "the robot's own controller is still at work"
        with pytest.raises(DemoHLMError, match="a policy for gripper hands"):
            Deployment(deployed(robot, domain, policy=other_hands))
        assert heard.newest() is None


@pytest.mark.parametrize(("options", "message"), [
    (["--interface", "nowhere0"], "no interface 'nowhere0'"),
    (["--interface", "lo", "--task", "LiftBoxes"], "did you mean 'LiftBox'"),
    (["--interface", "lo", "--task", "GraspCube"], "give --servo-port"),
    (["--interface", "lo", "--hands-free", "--pose-source", "apriltag", "--camera", "{}"], "give --tags"),
    (["--interface", "lo", "--root", "."], "which exists"),
])  # fmt: skip
def test_bad_options_are_one_line(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["deploy", "--policy", str(tmp_path), "--domain", str(free_domain()), *options]
    if "--task" not in options:
        given += ["--task", "LiftBox"]
    assert main(given) == 2
    error = capsys.readouterr().err.strip()
    assert message in error and error.count("\n") == 0 and error.startswith("error: got ")


def test_release_stops_the_robots_own_controller_once_the_deployment_asks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    handed: list[Any] = []

    def refuse(settings: DeploymentSettings, before_control: Any) -> None:
        handed.append(before_control)
        raise RobotError("a test", "its end", "nothing")

    monkeypatch.setattr(deployments, "Deployment", refuse)
    domain = free_domain()
    given = ["deploy", "--policy", str(tmp_path), "--task", "LiftBox", "--interface", "lo", "--domain", str(domain)]
    with own_controller(domain) as service:
        assert main(given) == 2 and "own controller 'ai'" in capsys.readouterr().err and not handed
        assert main([*given, "--release"]) == 2 and "got a test" in capsys.readouterr().err
        assert service.name == "ai", "the robot is limp without it: not before all else is ready"
        handed.pop()()
        assert service.name == ""
        for options in ([], ["--release"]):  # none runs
            assert main([*given, *options]) == 2 and "got a test" in capsys.readouterr().err
            handed.pop()()


def test_the_robot_is_released_when_all_is_ready_but_its_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    happened, refused, made = [], [], []

    def note(deployment: Deployment, *names: str) -> None:
        made.append(deployment)
        happened.append((names, (deployment.folder / GO).exists()))
        if names in refused:
            raise RobotError("a test", "its end", "nothing")

    def release() -> None:
        happened.append(("released", (made[-1].folder / GO).exists()))

    monkeypatch.setattr(Deployment, "_start", lambda deployment, name: None)
    monkeypatch.setattr(Deployment, "_wait_for_ready", note)
    settings = DeploymentSettings(task="LiftBox", interface="lo", policy=Path(), domain=free_domain())
    with Deployment(settings, release):
        assert happened == [(("policy", "pose"), False), ("released", False), (("control",), True)]
    happened.clear()
    refused.append(("policy", "pose"))
    with pytest.raises(RobotError, match="a test"):
        Deployment(settings, release)
    assert happened == [(("policy", "pose"), False)]


LEFT = """
import multiprocessing, sys, time
from lerobot_demohlm.hardware.deployment import Deployment
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings

class Left(Deployment):
    def _start(self, name):
        self.processes[name] = multiprocessing.get_context("fork").Process(target=time.sleep, args=(20,))
        self.processes[name].start()

    def _wait_for_ready(self, *names):
        pass

    def close(self):
        super().close()
        print([process.exitcode for process in self.processes.values()], self.folder.exists())

deployment = Left(DeploymentSettings(task="LiftBox", interface="lo", policy=None, domain=int(sys.argv[1])))
"""


def test_a_program_that_ends_without_closing_ends_its_processes() -> None:
    """They would hold the robot, and the program would wait for them for ever."""
    call = [sys.executable, "-c", LEFT, str(free_domain())]
    done = subprocess.run(call, cwd=REPOSITORY, capture_output=True, text=True, timeout=300.0)
    assert (done.returncode, done.stdout) == (0, f"{[-signal.SIGTERM] * 2} False\n"), done.stderr


class Quiet(Deployment):
    """A deployment without processes."""

    def __init__(self) -> None:
        self._closed, self._quiet, self._turned_s, self.said = False, threading.Event(), math.nan, 0

    def _say(self) -> None:
        self.said += 1

    def said_more(self) -> bool:
        before = self.said
        time.sleep(3 * OPERATOR_S)
        return self.said > before


def test_a_loop_of_keys_that_hangs_gives_no_sign_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    deployment = Quiet()
    thread = threading.Thread(target=deployment._operate, daemon=True)
    thread.start()
    until(deployment.said_more, 10.0)  # as under LeRobot, whose loop reads no keys
    deployment.note_turn()
    until(lambda: not deployment.said_more(), 10.0)
    monkeypatch.setattr("lerobot_demohlm.hardware.deployment.TURN_S", 1e9)
    until(deployment.said_more, 10.0)
    deployment._closed = True
    thread.join()


def test_each_turn_of_the_keys_is_noted() -> None:
    turns: list[int] = []
    deployment: Any = SimpleNamespace(
        mode=Mode.DAMP, reason="", request=print, estop=print, check=list, note_turn=lambda: turns.append(1)
    )
    options = deploy.Options(policy=Path(), task="LiftBox", interface="lo", hands_free=True, seconds=0.35)
    deploy._operate(options, deployment)
    assert turns


def test_a_record_says_which_policy_and_which_controller(tmp_path: Path) -> None:
    policy = save_policy(tmp_path / "policy")
    (tmp_path / "last").symlink_to(policy)
    found = _identify(DeploymentSettings(task="LiftBox", interface="lo", policy=tmp_path / "last"))
    assert found == {
        "policy": str(policy.resolve()), "policy_hash": policy_hash(policy), "controller": controllers.load().hash
    }  # fmt: skip
    assert _identify(DeploymentSettings(task="LiftBox", interface="lo", policy=None))["policy_hash"] is None


def test_eyes_and_policy_are_told_the_region(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told: list[str] = []
    for module, name in ((pose_process, "PoseProcess"), (policy_process, "PolicyProcess")):
        monkeypatch.setattr(module, name, lambda settings: told.append(settings.region))
    calibrated = {"pose": [0, 0, 0, 1, 0, 0, 0], "focal_px": 600}
    camera = json.dumps({"type": "opencv", "index_or_path": 0, "calibration": calibrated})
    plain = DeploymentSettings(
        task="LiftBox", interface="lo", policy=tmp_path, pose_source="remote,address=tcp://127.0.0.1:9", camera=camera
    )
    for settings in (plain, dataclasses.replace(plain, region="R4")):
        for name in ("pose", "policy"):
            _make_helper(name, settings, tmp_path)
    assert told == ["R3", "R3", "R4", "R4"]
    with pytest.raises(UnknownNameError, match="R1, R2, R3, R4"):
        dataclasses.replace(plain, region="R9")


def test_bad_faults_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'loss'"):
        Faults.of({"faults": [{"kind": "los", "at_s": 1.0}]})
    with pytest.raises(RobotError, match="faults that cannot be read"):
        Faults.of({"faults": [{"kind": "loss"}]})
    with pytest.raises(RobotError, match="no faults in"):
        Faults.read(tmp_path / "none.json")
    path = tmp_path / "faults.json"
    path.write_text("[]")
    with pytest.raises(RobotError, match="an empty list"):
        Faults.read(path)
    path.write_text('[{"faults": []}, {"faults": [{"kind": "loss"}]}]')
    with pytest.raises(RobotError, match="faults that cannot be read"):
        Faults.read(path)
    with pytest.raises(UnknownNameError, match="joint"):
        Fault(kind="nan", at_s=0.0, joint="tail")


@contextmanager
def commanded(deployment: Deployment) -> Iterator[threading.Event]:
    """Take the place of a policy that always wants to rest, until the event that is yielded is set."""
    silent = threading.Event()

    def act() -> None:
        step = 0
        while not silent.wait(0.1):
            control = deployment.read("control")
            if control is not None:
                deployment.write_command(command.rest(), int(control.value["since_ns"]), step)
                step += 1

    thread = threading.Thread(target=act)
    thread.start()
    try:
        yield silent
    finally:
        silent.set()
        thread.join()


def entered_ns(deployment: Deployment, mode: Mode) -> int:
    """Wait until a mode is entered; returns when (``time.monotonic_ns``)."""
    until(lambda: deployment.mode == mode, 10.0, pause_s=0.001)
    control = deployment.read("control")
    assert control is not None
    return int(control.value["since_ns"])


@pytest.mark.slow
def test_watchdogs_answer_in_time(hanging: tuple[RobotProcess, int], tmp_path: Path) -> None:
    """One robot, one thing after the other: policy silent, e-stop, controller killed."""
    robot, domain = hanging
    root = tmp_path / "record"
    with Deployment(deployed(robot, domain, root=root)) as deployment, commanded(deployment) as silent:
        until(lambda: deployment.read("state") is not None, 30.0)
        deployment.request(Mode.STAND)
        deployment.wait_for(Mode.STAND, 10.0)
        deployment.wait_for(Mode.STAND, 10.0, standing=True)
        deployment.request(Mode.RUN)
        deployment.wait_for(Mode.RUN, 5.0)
        time.sleep(1.0)
        silent.set()
        policy = deployment.read("policy")
        assert policy is not None
        held_ns = entered_ns(deployment, Mode.HOLD)
        last = deployment.read("policy")
        assert last is not None
        assert 0.300 <= 1e-9 * (held_ns - last.time_ns) < 0.330
        control = deployment.read("control")
        assert control is not None and not control.value["command"][command.VELOCITY].any()
        asked_ns = time.monotonic_ns()
        deployment.estop("key")
        assert 1e-9 * (entered_ns(deployment, Mode.DAMP) - asked_ns) < 0.040
        assert deployment.reason == "e-stop by key"
        deployment.request(Mode.STAND)
        deployment.wait_for(Mode.STAND, 10.0, standing=True)
        deployment.apply(Fault(kind="kill", at_s=0.0, process="control"))
        found = robot.wait_for("damped", 10.0)
        while found["silence_ms"] > 1000.0:  # of the time before the first command
            found = robot.wait_for("damped", 10.0)
        assert 50.0 <= found["silence_ms"] <= 60.0
    assert robot.end()["violations"] == 0
    reasons = set(recorder.read(root)["control.reason"].to_pylist())
    assert any(reason.startswith("policy silent for 0.30") for reason in reasons)
    assert "e-stop by key" in reasons


@pytest.mark.slow
def test_a_policy_that_dies_while_the_robot_stands_is_missed(hanging: tuple[RobotProcess, int], tmp_path: Path) -> None:
    robot, domain = hanging
    settings = deployed(
        robot, domain, policy=save_policy(tmp_path / "policy"), ages=dataclasses.replace(LONG, policy=1.0)
    )
    with Deployment(settings) as deployment:
        until(lambda: deployment.read("state") is not None, 30.0)
        deployment.request(Mode.STAND)
        deployment.wait_for(Mode.STAND, 10.0, standing=True)
        deployment.apply(Fault(kind="stop", at_s=0.0, process="policy"))
        time.sleep(2.0)
        deployment.request(Mode.RUN)
        until(lambda: deployment.reason == "will not run: no policy", 5.0)
        assert deployment.mode == Mode.STAND and deployment.standing


@pytest.mark.slow
def test_a_stopped_pose_source_holds_and_a_silent_robot_damps(
    hanging: tuple[RobotProcess, int], tmp_path: Path
) -> None:
    robot, domain = hanging
    with Deployment(deployed(robot, domain)) as deployment, commanded(deployment):
        until(lambda: deployment.read("state") is not None, 30.0)
        deployment.request(Mode.STAND)
        deployment.wait_for(Mode.STAND, 10.0, standing=True)
        deployment.request(Mode.RUN)
        deployment.wait_for(Mode.RUN, 5.0)
        deployment.apply(Fault(kind="stop", at_s=0.0, process="pose"))
        held_ns = entered_ns(deployment, Mode.HOLD)
        last = deployment.read("pose")
        assert last is not None and 0.500 <= 1e-9 * (held_ns - last.time_ns) < 0.530
        assert deployment.reason.startswith("pose stale")
        os.kill(robot.pid, signal.SIGSTOP)
        damped_ns = entered_ns(deployment, Mode.DAMP)
        state = deployment.read("state")
        assert state is not None and 0.040 <= 1e-9 * (damped_ns - state.time_ns) < 0.060
        assert deployment.reason.startswith("state lost")
        os.kill(robot.pid, signal.SIGCONT)
