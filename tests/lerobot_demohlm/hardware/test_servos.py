"""Robotis' own SDK on a simulated bus: pings, goals, positions, watchdog, and servos that do not answer."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.servo_units import GRIPPERS, NECK, goals
from lerobot_demohlm.hardware.servos import CHECK_EVERY, DynamixelBus, ServoProcess
from lerobot_demohlm.hardware.simulated_bus import SimulatedBus, checksum
from tests.helpers.robot import until

ALL = NECK + GRIPPERS


def test_goals_arrive_and_positions_come_back() -> None:
    simulated = SimulatedBus(ALL)
    bus = DynamixelBus(simulated.port, ALL)
    bus.enable(True)
    bus.send(goals(np.array([0.5, -0.3]), np.array([1.0, 0.25]), True))
    until(lambda: abs(simulated.goal(ALL[0]) - 0.5) < 2e-3, 5.0)
    found = [simulated.goal(servo) for servo in ALL]
    np.testing.assert_allclose(found, [0.5, -0.3, 0.045, 0.01125], atol=1e-3)
    assert all(simulated.holds(servo) for servo in ALL)
    for value, speed in ((0.2, 1.0), (-0.4, -0.024), (0.001, -0.3)):  # small negative numbers need byte stuffing
        simulated.set_present(ALL[1], value, speed)
        read = bus.read()
        assert read is not None
        assert ALL[1].value(read[2][0]) == pytest.approx(value, abs=1e-3)
        assert ALL[1].speed(read[2][1]) == pytest.approx(speed, abs=0.02)
    condition = bus.condition(ALL[0])
    assert condition is not None and condition.temperature == 35 and condition.holds
    bus.close()
    simulated.close()


def test_goals_stay_within_what_the_neck_can_do() -> None:
    for servo in ALL:
        for wanted in (-100.0, 100.0):
            assert servo.lower - 1e-3 <= servo.value(servo.steps(wanted)) <= servo.upper + 1e-3
            assert 0 <= servo.steps(wanted) < 4096


def test_a_servo_that_hears_nothing_stops_by_itself() -> None:
    simulated = SimulatedBus(NECK)
    bus = DynamixelBus(simulated.port, NECK)
    bus.enable(True)
    until(lambda: not simulated.holds(NECK[0]), 10.0)
    bus.close()
    simulated.close()


def test_a_missing_servo_and_a_missing_port_are_refused() -> None:
    simulated = SimulatedBus(NECK)
    simulated.muted.add(2)
    with pytest.raises(RobotError, match=r"no servo 2 at .*; expected servos 1, 2"):
        DynamixelBus(simulated.port, NECK)
    with pytest.raises(RobotError, match=r"no servos at /dev/nowhere.*dialout"):
        DynamixelBus("/dev/nowhere", NECK)
    simulated.close()


def test_the_process_moves_the_neck_only_while_goals_are_new(tmp_path: Path) -> None:
    simulated = SimulatedBus(NECK)
    process = ServoProcess(tmp_path, simulated.port, "LiftBox")
    goal = records.slot(tmp_path, "servo_goals")
    goal.write(records.record("servo_goals", neck=[0.4, 0.2], enabled=True))
    process._serve(0)
    until(lambda: simulated.holds(NECK[0]) and abs(simulated.goal(NECK[0]) - 0.4) < 2e-3, 5.0)
    present = records.slot(tmp_path, "servos").read()
    assert present is not None and present.value["temperature"][0] == 35
    goal.write(records.record("servo_goals", neck=[0.4, 0.2], enabled=True), 0)  # long ago
    process._serve(1)
    until(lambda: not simulated.holds(NECK[0]), 5.0)
    process._bus.close()
    simulated.close()


def test_a_watchdog_that_has_acted_stays_until_the_servo_is_enabled_again(tmp_path: Path) -> None:
    simulated = SimulatedBus(NECK)
    process = ServoProcess(tmp_path, simulated.port, "LiftBox")
    goal = records.slot(tmp_path, "servo_goals")

    def serve(count: int, angle: float) -> None:
        goal.write(records.record("servo_goals", neck=[angle, 0.0], enabled=True))
        process._serve(count)

    serve(1, 0.4)
    until(lambda: not simulated.holds(NECK[0]), 5.0)  # as after a pause of the process
    serve(2, 0.1)
    assert not simulated.holds(NECK[0]) and simulated.goal(NECK[0]) != pytest.approx(0.1, abs=2e-3)

    def served_again() -> bool:
        serve(CHECK_EVERY, 0.1)
        serve(CHECK_EVERY + 1, 0.1)
        return simulated.goal(NECK[0]) == pytest.approx(0.1, abs=2e-3)

    until(served_again, 20.0)
    assert process._reason == ""
    process._bus.close()
    simulated.close()


def test_a_servo_that_cannot_hold_is_told_with_its_reason(tmp_path: Path) -> None:
    simulated = SimulatedBus(NECK)
    process = ServoProcess(tmp_path, simulated.port, "LiftBox")
    goal, present = records.slot(tmp_path, "servo_goals"), records.slot(tmp_path, "servos")
    simulated.fail(NECK[1], 5)
    goal.write(records.record("servo_goals", neck=[0.4, 0.2], enabled=True))
    process._serve(CHECK_EVERY)
    process._serve(CHECK_EVERY + 1)
    reading = present.read()
    assert reading is not None and records.text(reading.value["reason"]) == "servo 2 has stopped: overload"
    assert not simulated.holds(NECK[1])
    process._bus.close()
    simulated.close()


def test_checksum_is_the_protocols() -> None:
    """Example of Dynamixel's manual: a ping of servo 1 ends in 19 4E."""
    assert checksum(bytes.fromhex("FFFFFD00010300 01")) == 0x4E19
