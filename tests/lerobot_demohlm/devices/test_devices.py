"""LeRobot's interfaces: the robot, what its actions mean, its starts, and a scripted operator that does the task."""

import json
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.robots import make_robot_from_config
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators import make_teleoperator_from_config
from lerobot.teleoperators.config import TeleoperatorConfig

import lerobot_env_demohlm  # noqa: F401  registers the devices, as LeRobot does
from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import UnknownNameError
from lerobot_demohlm.devices import DemoHLMG1Config, DemoHLMScriptConfig, DemoHLMWebConfig, live, operators
from lerobot_demohlm.devices.config_g1 import DeviceError
from lerobot_demohlm.devices.g1 import DemoHLMG1
from lerobot_demohlm.devices.operators import EPISODE_OVER_S, DemoHLMWeb
from lerobot_demohlm.teleop.session import SessionError
from tests.helpers.teleop import wait_for


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[DemoHLMG1]:
    made = make_robot_from_config(DemoHLMG1Config(pace="step", objects=True, calibration_dir=tmp_path))
    assert isinstance(made, DemoHLMG1)
    made.connect()
    yield made
    if made.is_connected:
        made.disconnect()


def test_they_are_registered_by_name() -> None:
    assert "demohlm_g1" in RobotConfig.get_known_choices()
    operators = {"demohlm_web", "demohlm_keyboard", "demohlm_gamepad", "demohlm_script"}
    assert operators <= set(TeleoperatorConfig.get_known_choices())


def test_options_are_checked() -> None:
    with pytest.raises(UnknownNameError):
        DemoHLMG1Config(task="LiftBoxes")
    with pytest.raises(DeviceError, match="backend 'zmq'"):
        DemoHLMG1Config(backend="zmq")
    with pytest.raises(DeviceError, match=r"name it with --robot\.interface"):
        DemoHLMG1Config(backend="dds")


def test_features_are_ours(robot: DemoHLMG1) -> None:
    assert tuple(robot.observation_features)[:68] == observation.STATE_NAMES
    assert tuple(robot.action_features) == command.NAMES
    assert set(robot.get_observation()) == set(robot.observation_features)


def test_actions_may_be_partial_foreign_and_out_of_bounds(robot: DemoHLMG1) -> None:
    rest = command.rest()
    sent = robot.send_action({"kLeftElbow.q": 0.9, "remote.ly": 1.0, "kLeftKnee.q": 1.0, "nonsense": 3.0})
    told = np.array([sent[name] for name in command.NAMES])
    changed = {command.NAMES[i] for i in np.flatnonzero(told != rest)}
    assert changed == {"left_elbow.pos", "base_x.vel"}
    assert sent["base_x.vel"] == pytest.approx(0.45) and sent["left_elbow.pos"] == pytest.approx(0.9)
    sent = robot.send_action({"torso_pitch.pos": 9.0})
    assert sent["torso_pitch.pos"] == command.UPPER[command.PITCH]
    assert sent["base_x.vel"] == 0.0 and sent["left_elbow.pos"] == pytest.approx(0.9)
    with pytest.raises(DeviceError, match="NaN"):
        robot.send_action({"torso_pitch.pos": float("nan")})


def test_the_same_actions_give_the_same_bits(robot: DemoHLMG1, tmp_path: Path) -> None:
    other = DemoHLMG1(DemoHLMG1Config(pace="step", objects=True, calibration_dir=tmp_path))
    other.connect()
    for number in range(5):
        action = {"base_x.vel": 0.1 * number, "left_elbow.pos": 0.9}
        robot.send_action(action)
        other.send_action(action)
        assert robot.get_observation() == other.get_observation()
    other.disconnect()


def test_a_script_does_the_task_in_every_episode_from_a_new_start(robot: DemoHLMG1, tmp_path: Path) -> None:
    operator = make_teleoperator_from_config(DemoHLMScriptConfig(calibration_dir=tmp_path))
    operator.connect()
    starts = []
    for _ in range(2):
        starts.append(robot.get_observation()["box_r11.pos"])
        succeeded = []
        for _ in range(85):
            robot.get_observation()
            robot.send_action(operator.get_action())
            world = live.current()
            assert world is not None
            succeeded.append(world.seen.success)
        assert all(succeeded[-10:])
        robot.reset()
        assert world.seen.step == 0
    assert starts[0] != starts[1]
    operator.disconnect()


def test_a_world_by_the_clock_stands_where_no_action_comes(tmp_path: Path) -> None:
    robot = DemoHLMG1(DemoHLMG1Config(calibration_dir=tmp_path))
    robot.connect()
    world = live.current()
    assert world is not None
    robot.send_action({"base_x.vel": 0.4})
    wait_for(lambda: world.sim.command[0, 0] > 0.3)
    wait_for(lambda: world.sim.command[0, 0] == 0.0)
    robot.disconnect()
    assert live.current() is None


def test_the_page_is_served_once_there_is_a_world(
    robot: DemoHLMG1, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    operator = make_teleoperator_from_config(DemoHLMWebConfig(port=0, calibration_dir=tmp_path))
    operator.connect()
    for _ in range(3):
        action = operator.get_action()
        robot.send_action(action)
    assert not any(action[name] for name in command.NAMES[:3])
    printed: list[str] = []
    wait_for(lambda: printed.append(capsys.readouterr().out) or "serving" in "".join(printed))
    served = json.loads("".join(printed))["operator"]
    second = make_teleoperator_from_config(DemoHLMWebConfig(port=urlsplit(served).port, calibration_dir=tmp_path))
    second.connect()
    second.get_action()
    wait_for(lambda: printed.append(capsys.readouterr().out) or "--teleop.port" in "".join(printed))
    second.disconnect()
    operator.disconnect()


def test_the_page_does_not_begin_anew_within_an_episode(robot: DemoHLMG1, tmp_path: Path) -> None:
    """LeRobot would store the end of one motion and the whole of another as one episode."""
    operator = DemoHLMWeb(DemoHLMWebConfig(port=0, calibration_dir=tmp_path))
    operator.connect()
    robot.send_action(operator.get_action())
    world, page = live.current(), operator._stage
    assert world is not None and page is not None
    features = {"action": {"dtype": "float32", "shape": (1,), "names": None}}
    dataset = LeRobotDataset.create("local/test", 10, features, root=tmp_path / "data", use_videos=False)
    page.press("discard")
    dataset.add_frame({"action": np.zeros(1, dtype=np.float32), "task": "lift"})
    robot.send_action(operator.get_action())
    begun = world.seen
    with pytest.raises(SessionError, match="left arrow"):
        page.press("discard")
    assert world.seen is begun
    dataset.clear_episode_buffer()
    assert world.seen.episode == begun.episode + 1
    page.press("discard")
    assert world.seen.episode == begun.episode + 2
    dataset.add_frame({"action": np.zeros(1, dtype=np.float32), "task": "lift"})
    world.framed_s -= EPISODE_OVER_S  # the episode is over, and LeRobot waits before it stores it
    page.press("discard")
    assert world.seen.episode == begun.episode + 3
    operator.disconnect()


@pytest.mark.parametrize("heard", [False, True])
def test_the_page_says_where_lerobots_keys_are(
    robot: DemoHLMG1, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, heard: bool
) -> None:
    monkeypatch.setattr(operators, "pynput_can_capture", lambda: heard)
    operator = DemoHLMWeb(DemoHLMWebConfig(port=0, calibration_dir=tmp_path))
    operator.connect()
    operator.get_action()
    assert operator._stage is not None
    assert ("hears the keys of this page" if heard else "at the terminal") in operator._stage.status().message
    operator.disconnect()
