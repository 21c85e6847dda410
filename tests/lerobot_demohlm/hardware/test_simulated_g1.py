"""The simulated robot's own options, without a network."""

import pytest

from gym_demohlm.errors import UnknownNameError
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.simulated_g1 import SimulatedG1, SimulatedSettings
from tests.helpers.robot import free_domain


def test_only_the_robot_may_vary() -> None:
    with pytest.raises(RobotError, match="real:robot"):
        SimulatedSettings(task="LiftBox", interface="lo", variation="real:robot+objects")
    with pytest.raises(UnknownNameError, match="did you mean 'real'"):
        SimulatedSettings(task="LiftBox", interface="lo", variation="reel:robot")


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
