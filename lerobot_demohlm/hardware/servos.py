"""Goals for neck and grippers -> Dynamixel servos on a serial bus, and their positions back: a process of its own.

The servos watch the bus themselves: one that hears nothing for 200 ms stops, and takes no goal until it is enabled
again. Each second every servo is asked whether it holds. One that does not is enabled again; where that does not help,
the slot says why, and the robot holds.
"""

import os
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import numpy as np
import serial

from gym_demohlm.registry import get_task
from lerobot_demohlm.hardware import records, servo_units
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.servo_units import GRIPPERS, NECK, Servo

BAUD = 1_000_000
PERIOD_S = 0.02
CHECK_EVERY = 50  # periods
_PROTOCOL = 2.0
_PINGS = 20
_WAIT_S = 0.002  # that a read may wait for bytes; the SDK counts its own time-outs of some 35 ms
_POSITION, _VELOCITY = servo_units.PRESENT_POSITION, servo_units.PRESENT_VELOCITY


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What a servo says of itself.

    Attributes:
        torque: Whether it is switched on.
        watchdog: After how many units of 20 ms without the bus it stops; ``WATCHDOG_ACTED`` once it has.
        hardware_error: Bits of ``HARDWARE_ERRORS``.
        temperature: Its temperature [Celsius].
    """

    torque: bool
    watchdog: int
    hardware_error: int
    temperature: int

    @property
    def holds(self) -> bool:
        """Whether it goes where it is sent."""
        return self.torque and self.watchdog == servo_units.WATCHDOG_UNITS and not self.hardware_error

    @property
    def errors(self) -> str:
        """The names of its hardware errors; empty for none."""
        bits = (bit for bit in range(8) if self.hardware_error >> bit & 1)
        return ", ".join(servo_units.HARDWARE_ERRORS.get(bit, f"error bit {bit}") for bit in bits)


class DynamixelBus:
    """Servos on one serial port.

    Args:
        port: Path of the device, such as /dev/ttyUSB0.
        servos: Those that must answer.

    Raises:
        RobotError: The port cannot be opened, or a servo does not answer.
    """

    def __init__(self, port: str, servos: tuple[Servo, ...]) -> None:
        self._servos = servos
        self._port, self._packets = sdk.PortHandler(port), sdk.PacketHandler(_PROTOCOL)
        if not Path(port).exists() or not os.access(port, os.R_OK | os.W_OK):
            raise RobotError(
                f"no servos at {port}", "a serial port that may be read and written",
                "check --servo-port, and that you are in the group dialout",
            )  # fmt: skip
        try:
            self._port.setBaudRate(BAUD)
            assert self._port.ser is not None  # it is open now
            self._port.ser.timeout = _WAIT_S  # the SDK would ask without a pause, and take half of a core
        except (OSError, serial.SerialException) as error:
            raise RobotError(f"{port}: {error}", "a serial port of 1 Mbit/s", "check --servo-port") from error
        self._writer = sdk.GroupSyncWrite(self._port, self._packets, servo_units.GOAL_POSITION, 4)
        self._reader = sdk.GroupSyncRead(self._port, self._packets, servo_units.PRESENT_VELOCITY, 8)
        for servo in servos:
            self._reader.addParam(servo.id)
            if not any(self._packets.ping(self._port, servo.id)[1] == sdk.COMM_SUCCESS for _ in range(_PINGS)):
                self.close()
                raise RobotError(
                    f"no servo {servo.id} at {port}", f"servos {', '.join(str(each.id) for each in servos)}",
                    "check power, cable, identity and 1 Mbit/s",
                )  # fmt: skip

    def enable(self, on: bool) -> None:
        """Hold, or let go; either way the servos watch the bus from now on."""
        for servo in self._servos:
            self._packets.write1ByteTxRx(self._port, servo.id, servo_units.BUS_WATCHDOG, 0)  # clears one that has acted
            self._packets.write1ByteTxRx(self._port, servo.id, servo_units.TORQUE_ENABLE, int(on))
            if on:
                units = servo_units.WATCHDOG_UNITS
                self._packets.write1ByteTxRx(self._port, servo.id, servo_units.BUS_WATCHDOG, units)

    def send(self, goals: Mapping[int, int]) -> None:
        """Send goal positions by id [steps], all in one packet."""
        self._writer.clearParam()
        for number, steps in goals.items():
            self._writer.addParam(number, list(int(steps).to_bytes(4, "little", signed=True)))
        self._writer.txPacket()

    def read(self) -> dict[int, tuple[int, int]] | None:
        """Return positions [steps] and velocities [units] by id; None where a servo does not answer."""
        if self._reader.txRxPacket() != sdk.COMM_SUCCESS:
            return None
        try:
            return {servo.id: (self._get(servo, _POSITION), self._get(servo, _VELOCITY)) for servo in self._servos}
        except IndexError:  # the SDK takes a damaged packet for a short one
            return None

    def _get(self, servo: Servo, address: int) -> int:
        if not self._reader.isAvailable(servo.id, address, 4):
            raise IndexError(f"no answer of servo {servo.id}")
        return _signed(self._reader.getData(servo.id, address, 4))

    def condition(self, servo: Servo) -> Condition | None:
        """Return what a servo says of itself, read at once; None where it does not answer."""
        first, last = servo_units.TORQUE_ENABLE, servo_units.PRESENT_TEMPERATURE
        found, result, _ = self._packets.readTxRx(self._port, servo.id, first, last - first + 1)
        if result != sdk.COMM_SUCCESS or len(found) <= last - first:
            return None
        return Condition(
            torque=bool(found[0]),
            watchdog=int(found[servo_units.BUS_WATCHDOG - first]),
            hardware_error=int(found[servo_units.HARDWARE_ERROR - first]),
            temperature=int(found[last - first]),
        )

    def close(self) -> None:
        """Close the port."""
        with suppress(OSError):
            self._port.closePort()


class ServoProcess:
    """Carries goals to the servos and positions back, at 50 Hz.

    Args:
        folder: Of the slots.
        port: Path of the serial device.
        task: Name of the task, which says whether there are grippers.

    Raises:
        RobotError: As ``DynamixelBus``.
    """

    def __init__(self, folder: Path, port: str, task: str) -> None:
        self._has_grippers = get_task(task).hands == "gripper"
        self._servos = NECK + (GRIPPERS if self._has_grippers else ())
        self._bus = DynamixelBus(port, self._servos)
        self._goals, self._present = records.slot(folder, "servo_goals"), records.slot(folder, "servos")
        self._stop, self._errors, self._enabled = False, 0, False
        self._temperatures, self._reason = np.zeros(4, np.int16), ""
        self._serve(0)

    def run(self) -> None:
        """Serve until a signal asks for the end; then let go."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        due, count = time.monotonic(), 0
        try:
            while not self._stop:
                try:
                    self._serve(count)
                except (OSError, serial.SerialException) as error:
                    raise RobotError(
                        f"servos that are gone ({error})", "a port that stays", "check the cable"
                    ) from error
                count += 1
                due = max(due + PERIOD_S, time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
        finally:
            with suppress(OSError, serial.SerialException):
                self._bus.enable(False)
            self._bus.close()

    def _serve(self, count: int) -> None:
        """Send the newest goals, read the positions."""
        reading = self._goals.read()
        enabled = reading is not None and bool(reading.value["enabled"]) and reading.age_s < 0.2
        if enabled != self._enabled:
            self._bus.enable(enabled)
            self._enabled = enabled
        if enabled:
            assert reading is not None
            value = reading.value
            self._bus.send(servo_units.goals(value["neck"], value["grippers"], self._has_grippers))
        measured_ns, found = time.monotonic_ns(), self._bus.read()
        if found is None:
            self._errors += 1
            return
        if count % CHECK_EVERY == 0:
            self._reason = self._check()
        fields: dict[str, Any] = {
            "temperature": self._temperatures, "errors": self._errors,
            "reason": self._reason.encode()[: records.REASON_SIZE],
        }  # fmt: skip
        for name, group in (("neck", NECK), ("jaws", GRIPPERS)):
            if group[0].id in found:
                fields[name] = [servo.value(found[servo.id][0]) for servo in group]
                fields[f"{name}_dq"] = [servo.speed(found[servo.id][1]) for servo in group]
        self._present.write(records.record("servos", **fields), measured_ns)

    def _check(self) -> str:
        """Enable servos again that should hold and do not; returns why one still does not, empty where all do."""
        found = self._conditions()
        if self._enabled and not all(condition.holds for condition in found.values()):
            self._bus.enable(True)
            found = self._conditions()
        for index, servo in enumerate(self._servos):
            self._temperatures[index] = found[servo].temperature if servo in found else 0
        for servo, condition in found.items():
            if condition.hardware_error:
                return f"servo {servo.id} has stopped: {condition.errors}"
            if self._enabled and not condition.holds:
                return f"servo {servo.id} cannot be switched on"
        return ""

    def _conditions(self) -> dict[Servo, Condition]:
        """Return what the servos say that answer."""
        asked = {servo: self._bus.condition(servo) for servo in self._servos}
        return {servo: condition for servo, condition in asked.items() if condition is not None}


def _signed(value: int) -> int:
    return int.from_bytes(int(value & 0xFFFFFFFF).to_bytes(4, "little"), "little", signed=True)
