"""Bytes and checksums of LowCmd and LowState against cyclonedds' serializer and the algorithm of the robot's SDK."""

import struct

import numpy as np
import pytest
from cyclonedds import idl as dds

from lerobot_demohlm.hardware import idl
from lerobot_demohlm.hardware.crc import crc_of_words
from lerobot_demohlm.hardware.layout import NUM_SLOTS, LowCmd, LowState


def reference_crc(words: np.ndarray) -> np.ndarray:
    """The SDK's loop over words and bits, for many messages (n, words) at once."""
    crc = np.full(len(words), 0xFFFFFFFF, np.uint64)
    for word in words.T.astype(np.uint64):
        for bit in range(31, -1, -1):
            top = (crc >> np.uint64(31)) & np.uint64(1)
            crc = (crc << np.uint64(1)) & np.uint64(0xFFFFFFFF)
            crc ^= top * np.uint64(0x04C11DB7)
            crc ^= ((word >> np.uint64(bit)) & np.uint64(1)) * np.uint64(0x04C11DB7)
    return crc


def random_cmd(rng: np.random.Generator) -> tuple[LowCmd, idl.LowCmd_]:
    """Return the same random command in our layout, and as cyclonedds' object."""
    numbers = rng.normal(scale=10.0, size=(5, NUM_SLOTS)).astype(np.float32)
    modes = rng.integers(0, 256, NUM_SLOTS)
    ours = LowCmd()
    ours.mode_pr, ours.mode_machine = rng.integers(0, 256, 2).tolist()
    ours.mode = modes
    for view, values in zip((ours.q, ours.dq, ours.tau, ours.kp, ours.kd), numbers, strict=True):
        view[:] = values
    ours.seal()
    motors = [idl.MotorCmd_(int(mode), *map(float, column), 0) for mode, column in zip(modes, numbers.T, strict=True)]
    return ours, idl.LowCmd_(ours.mode_pr, ours.mode_machine, motors, [0] * 4, ours.crc)


def c_struct_of_cmd(message: idl.LowCmd_) -> np.ndarray:
    """Return the words that the SDK computes the checksum of: its struct without the last one."""
    numbers: list[float] = [message.mode_pr, message.mode_machine]
    for motor in message.motor_cmd:
        numbers += [motor.mode, motor.q, motor.dq, motor.tau, motor.kp, motor.kd, motor.reserve]
    packed = struct.pack("<2B2x" + "B3x5fI" * NUM_SLOTS + "5I", *numbers, *message.reserve, message.crc)
    return np.frombuffer(packed, "<u4")[:-1]


def check_commands(count: int) -> None:
    rng = np.random.default_rng(28)
    words, sums = [], []
    for _ in range(count):
        ours, theirs = random_cmd(rng)
        assert ours.to_bytes() == dds.IdlStruct.serialize(theirs)
        assert LowCmd(ours.to_bytes()).is_sound()
        words.append(c_struct_of_cmd(theirs))
        sums.append(ours.crc)
    np.testing.assert_array_equal(reference_crc(np.array(words)), sums)


def test_commands_have_the_bytes_and_checksums_of_the_robot() -> None:
    check_commands(300)


@pytest.mark.slow
def test_ten_thousand_commands_have_the_bytes_and_checksums_of_the_robot() -> None:
    check_commands(10_000)


def random_state(rng: np.random.Generator) -> tuple[LowState, idl.LowState_]:
    ours = LowState()
    imu = rng.normal(size=13).astype(np.float32)
    motors, remote = rng.normal(size=(NUM_SLOTS, 5)).astype(np.float32), rng.integers(0, 256, 40)
    temperatures, modes = rng.integers(-40, 120, (NUM_SLOTS, 2)), rng.integers(0, 256, NUM_SLOTS)
    ours.quat_wxyz[:], ours.gyro[:], ours.accelerometer[:], ours.rpy[:] = np.split(imu, (4, 7, 10))
    for column, view in enumerate((ours.q, ours.dq, ours.ddq, ours.tau, ours.voltage)):
        view[:] = motors[:, column]
    ours.temperature[:], ours.remote[:], ours.mode = temperatures, remote, modes
    ours.mode_pr, ours.mode_machine, ours.tick = 0, 5, int(rng.integers(0, 2**32))
    ours.seal()
    theirs = idl.LowState_(
        [0, 0], 0, 5, ours.tick,
        idl.IMUState_(*(part.tolist() for part in np.split(imu, (4, 7, 10))), 0),
        [
            idl.MotorState_(int(mode), *row[:4].tolist(), temperature.tolist(), float(row[4]), [0, 0], 0, [0] * 4)
            for mode, row, temperature in zip(modes, motors, temperatures, strict=True)
        ],
        remote.tolist(), [0] * 4, ours.crc,
    )  # fmt: skip
    return ours, theirs


def c_struct_of_state(message: idl.LowState_) -> np.ndarray:
    imu = message.imu_state
    numbers: list[float] = [*message.version, message.mode_pr, message.mode_machine, message.tick]
    numbers += [*imu.quaternion, *imu.gyroscope, *imu.accelerometer, *imu.rpy, imu.temperature]
    for motor in message.motor_state:
        numbers += [motor.mode, motor.q, motor.dq, motor.ddq, motor.tau_est, *motor.temperature, motor.vol]
        numbers += [*motor.sensor, motor.motorstate, *motor.reserve]
    numbers += [*message.wireless_remote, *message.reserve, message.crc]
    packed = struct.pack("<2I2B2xI" + "13fh2x" + "B3x4f2hf7I" * NUM_SLOTS + "40B5I", *numbers)
    return np.frombuffer(packed, "<u4")[:-1]


def test_states_have_the_bytes_and_checksums_of_the_robot() -> None:
    rng = np.random.default_rng(29)
    words, sums = [], []
    for _ in range(100):
        ours, theirs = random_state(rng)
        assert ours.to_bytes() == dds.IdlStruct.serialize(theirs)
        words.append(c_struct_of_state(theirs))
        sums.append(ours.crc)
    np.testing.assert_array_equal(reference_crc(np.array(words)), sums)


def test_every_flipped_bit_is_noticed() -> None:
    state, _ = random_state(np.random.default_rng(30))
    assert state.is_sound()
    rng = np.random.default_rng(31)
    for byte in rng.integers(4, LowState.SIZE - 4, 200):
        if byte - 4 in (10, 11):  # padding, which says nothing
            continue
        damaged = state.copy()
        damaged.buffer[byte] ^= 1 << int(rng.integers(8))
        assert not damaged.is_sound(), byte


def test_checksum_of_words_is_that_of_the_standard() -> None:
    """CRC-32/MPEG-2 of "123456789" is 0376E6E7; here of whole words, against the loop over bits."""
    words = np.frombuffer(b"12345678", ">u4")
    assert crc_of_words(words) == int(reference_crc(words[None])[0])


@pytest.mark.parametrize("content", [b"", bytes(1004), bytes([0, 1, 0, 0]) + bytes(999)])
def test_other_bytes_are_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"got .*; expected"):
        LowCmd(content)


def test_states_with_nan_or_no_rotation_are_not_finite() -> None:
    state = LowState()
    assert not state.is_finite()
    state.quat_wxyz[0] = 1.0
    assert state.is_finite()
    state.q[28] = np.nan
    assert not state.is_finite()
