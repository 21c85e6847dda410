"""A pseudo-terminal <-> four servos that speak Dynamixel's protocol 2.0, as far as this project's bus asks them to.

Ping, read, write, sync read and sync write with their checksums; a servo whose bus watchdog runs out stops where it is,
and takes no goal until 0 is written to that; one with a hardware error cannot be switched on.
"""

import contextlib
import os
import threading
import time
import tty
from pathlib import Path

import numpy as np

from lerobot_demohlm.hardware import servo_units
from lerobot_demohlm.hardware.servo_units import Servo

_HEADER = b"\xff\xff\xfd\x00"
_PING, _READ, _WRITE, _STATUS, _SYNC_READ, _SYNC_WRITE = 0x01, 0x02, 0x03, 0x55, 0x82, 0x83
_TABLE = 256  # bytes of a servo's control table that exist here


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ 0x8005 if value & 0x8000 else value << 1
        table.append(value & 0xFFFF)
    return table


_CRC = _crc_table()


def checksum(packet: bytes) -> int:
    """Return the CRC-16 of a packet without its last two bytes."""
    value = 0
    for byte in packet:
        value = ((value << 8) ^ _CRC[(value >> 8) ^ byte]) & 0xFFFF
    return value


class SimulatedBus:
    """Servos at the other end of a pseudo-terminal, served by a thread.

    Args:
        servos: Those on the bus.

    Attributes:
        port: Path to open.
        muted: Ids of servos that do not answer.
    """

    def __init__(self, servos: tuple[Servo, ...]) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._ours)
        tty.setraw(self._theirs)
        self.port = os.ttyname(self._theirs)
        self.muted: set[int] = set()
        self._tables = {servo.id: bytearray(_TABLE) for servo in servos}
        self._heard = dict.fromkeys(self._tables, time.monotonic())
        self._lock, self._stop = threading.Lock(), threading.Event()
        for servo in servos:
            self._put(servo.id, servo_units.GOAL_POSITION, servo.zero, 4)
            self.set_present(servo, 0.0, 0.0)
            self._put(servo.id, servo_units.PRESENT_TEMPERATURE, 35, 1)
        self._thread = threading.Thread(target=self._serve, name="servos", daemon=True)
        self._thread.start()

    def link(self, path: Path) -> None:
        """Make a path lead to the port."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(self.port)

    def holds(self, servo: Servo) -> bool:
        """Return whether a servo holds: switched on, and its watchdog has heard of the bus."""
        with self._lock:
            table = self._watched(servo.id)
            acted = table[servo_units.BUS_WATCHDOG] == servo_units.WATCHDOG_ACTED
            return bool(table[servo_units.TORQUE_ENABLE]) and not acted

    def goal(self, servo: Servo) -> float:
        """Return where a servo is sent [rad or m]."""
        with self._lock:
            first = servo_units.GOAL_POSITION
            return servo.value(int.from_bytes(self._tables[servo.id][first : first + 4], "little", signed=True))

    def set_present(self, servo: Servo, value: float, speed: float) -> None:
        """Have a servo be somewhere [rad or m] and move [rad/s or m/s]."""
        steps = round(servo.zero + servo.ratio * value * servo_units.STEPS / (2 * np.pi))
        self._put(servo.id, servo_units.PRESENT_POSITION, steps, 4)
        self._put(servo.id, servo_units.PRESENT_VELOCITY, round(servo.ratio * speed / servo_units.SPEED_STEP), 4)

    def fail(self, servo: Servo, bit: int) -> None:
        """Have a servo let go for good, with one of ``HARDWARE_ERRORS``."""
        self._put(servo.id, servo_units.HARDWARE_ERROR, 1 << bit, 1)
        self._put(servo.id, servo_units.TORQUE_ENABLE, 0, 1)

    def close(self) -> None:
        """Take the servos off the bus."""
        self._stop.set()
        for end in (self._theirs, self._ours):
            with contextlib.suppress(OSError):
                os.close(end)

    def _put(self, number: int, address: int, value: int, size: int) -> None:
        with self._lock:
            self._tables[number][address : address + size] = value.to_bytes(size, "little", signed=size > 1)

    def _watched(self, number: int) -> bytearray:
        """Return a servo's table, once its watchdog has acted if it is time; the lock is held."""
        table = self._tables[number]
        units = table[servo_units.BUS_WATCHDOG]
        if 0 < units < 128 and time.monotonic() - self._heard[number] > 0.02 * units:
            table[servo_units.BUS_WATCHDOG] = servo_units.WATCHDOG_ACTED
        return table

    @staticmethod
    def _refuses(table: bytearray, address: int, content: bytes) -> bool:
        if address == servo_units.TORQUE_ENABLE:
            return bool(table[servo_units.HARDWARE_ERROR])
        acted = table[servo_units.BUS_WATCHDOG] == servo_units.WATCHDOG_ACTED
        lifts = address == servo_units.BUS_WATCHDOG and content == b"\0"
        return acted and not lifts and address in (servo_units.BUS_WATCHDOG, servo_units.GOAL_POSITION)

    def _serve(self) -> None:
        pending = b""
        while not self._stop.is_set():
            try:
                pending += os.read(self._ours, 4096)
            except OSError:
                return
            while True:
                start = pending.find(_HEADER)
                if start < 0 or len(pending) < start + 7:
                    break
                size = int.from_bytes(pending[start + 5 : start + 7], "little")
                packet, rest = pending[start : start + 7 + size], pending[start + 7 + size :]
                if len(packet) < 7 + size:
                    break
                pending = rest
                if checksum(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                    self._obey(packet[4], packet[7], packet[8:-2])

    def _obey(self, number: int, instruction: int, parameters: bytes) -> None:
        if instruction == _SYNC_WRITE:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            for first in range(4, len(parameters), size + 1):
                self._write(parameters[first], address, parameters[first + 1 : first + 1 + size])
        elif instruction == _SYNC_READ:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            for each in parameters[4:]:
                self._answer_read(each, address, size)
        elif number in self._tables and number not in self.muted:
            if instruction == _PING:
                self._answer(number, bytes([0xB8, 0x04, 0x34]))
            elif instruction == _READ:
                self._answer_read(number, *(int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2)))
            elif instruction == _WRITE:
                self._write(number, int.from_bytes(parameters[:2], "little"), parameters[2:])
                self._answer(number, b"")

    def _write(self, number: int, address: int, content: bytes) -> None:
        if number in self._tables and number not in self.muted:
            with self._lock:
                table, self._heard[number] = self._watched(number), time.monotonic()
                if not self._refuses(table, address, content):
                    table[address : address + len(content)] = content

    def _answer_read(self, number: int, address: int, size: int) -> None:
        if number in self._tables and number not in self.muted:
            with self._lock:
                table, self._heard[number] = self._watched(number), time.monotonic()
                content = bytes(table[address : address + size])
            self._answer(number, content)

    def _answer(self, number: int, content: bytes) -> None:
        stuffed = content.replace(_HEADER[:3], _HEADER[:3] + b"\xfd")  # or it would look like a header
        plain = bytes([number]) + (len(stuffed) + 4).to_bytes(2, "little") + bytes([_STATUS, 0]) + stuffed
        packet = _HEADER + plain
        with contextlib.suppress(OSError):
            os.write(self._ours, packet + checksum(packet).to_bytes(2, "little"))
