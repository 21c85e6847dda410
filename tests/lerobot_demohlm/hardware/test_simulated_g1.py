"""The simulated robot's own options, without a network."""

import json
import time
from pathlib import Path

import pytest

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.registry import get_task
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.faults import Faults
from lerobot_demohlm.hardware.simulated_g1 import SimulatedG1, SimulatedSettings
from tests.helpers.domains import free_domain


def test_only_the_robot_may_vary() -> None:
    with pytest.raises(RobotError, match="real:robot"):
        SimulatedSettings(task="LiftBox", interface="lo", variation="real:robot+objects")
    with pytest.raises(UnknownNameError, match="did you mean 'real'"):
        SimulatedSettings(task="LiftBox", interface="lo", variation="reel:robot")
    with pytest.raises(RobotError, match="other shapes"):
        SimulatedSettings(task="LiftBox", interface="lo", region="R4")
    assert get_task("StackCube").wide_form is None
    SimulatedSettings(task="StackCube", interface="lo", region="R4")


def test_each_start_has_a_robot_of_its_own() -> None:
    settings = SimulatedSettings(
        task="LiftBox", interface="lo", domain=free_domain(), region="R1", variation="hard:robot", seed=4
    )
    said: list[dict] = []
    robot = SimulatedG1(settings, said.append)
    masses = [robot.sim._models[0][0].body_mass.sum()]
    robot._hang()
    masses.append(robot.sim._models[0][0].body_mass.sum())
    plain = robot.sim.scene.physics.body_mass.sum()
    assert len({round(mass, 6) for mass in (*masses, plain)}) == 3
    assert all("robot.payload" in event["start"] for event in said)
    robot.sim.close()


def test_starts_have_the_faults_of_a_file_by_turns(tmp_path: Path) -> None:
    """A frozen counter in the first start and every second one after it, a hot motor in the others."""
    path = tmp_path / "faults.json"
    kinds = ["frozen_tick", "hot_motor"]
    path.write_text(json.dumps([{"seed": 5 * i, "faults": [{"kind": kinds[i], "at_s": 0.0}]} for i in range(2)]))
    faults = Faults.read(path)
    assert [entry.seed for entry in faults] == [0, 5]
    settings = SimulatedSettings(task="LiftBox", interface="lo", domain=free_domain(), region="R1", faults=faults)
    said: list[dict] = []
    robot = SimulatedG1(settings, said.append)
    for number in range(3):
        robot._free_since = time.monotonic() - 1.0
        for _ in range(3):
            robot._speak(robot.sim.model, robot.sim.mj_data(0))
        assert said[-1] | {"event": "fault", "kind": kinds[number % 2]} == said[-1]
        assert (robot._state.temperature.max() == 100) == (number % 2 == 1)
        robot._hang()
    robot.sim.close()
    assert [event["executed"] for event in said if event["event"] == "hangs"] == [0, 0, 0, 0]
