"""LowCmd and LowState of a G1 <-> the bytes that DDS carries, by fixed offsets.

Both messages have one size, so a field is a view of the buffer: packing takes microseconds, where cyclonedds' own
serializer takes milliseconds. The bytes are those of ``unitree_hg.msg.dds_`` in XCDR1, little-endian: a header of four
bytes, then a body. The checksum is over the C struct, in which the first motor begins on a word of its own.
"""

from typing import Self

import numpy as np

from lerobot_demohlm.hardware.crc import crc_of_words

NUM_SLOTS = 35  # motors that a message has room for; a G1 of 29 joints leaves the rest at zero
NUM_JOINTS = 29
HEADER = bytes([0, 1, 0, 0])
MODE_MACHINE_29 = 5
"""What a G1 with 29 joints says of itself; commands must repeat it."""
MODE_PR = 0  # ankles and waist by pitch and roll, not by their two motors
ENABLED = 1  # a motor's mode


class _Message:
    """Bytes with a header, a body and a checksum in the last word."""

    SIZE: int
    _FIRST_MODE: int  # byte of the body with the mode of the first motor
    _SPLIT: int  # word of the body that this mode shares with what comes before it
    _modes: np.ndarray  # (35,) bytes of the body with the modes of the motors

    def __init__(self, content: bytes | None = None) -> None:
        self.buffer = np.zeros(self.SIZE, np.uint8)
        if content is None:
            self.buffer[:4] = np.frombuffer(HEADER, np.uint8)
        elif len(content) != self.SIZE or content[:4] != HEADER:
            raise ValueError(f"got {len(content)} bytes after {content[:4]!r}; expected {self.SIZE} after {HEADER!r}")
        else:
            self.buffer[:] = np.frombuffer(content, np.uint8)
        self._body = self.buffer[4:]
        self._words = self._body.view("<u4")

    @property
    def mode(self) -> np.ndarray:
        """(35,) uint8 modes of the motors, a copy; 1 is enabled."""
        return self._body[self._modes]

    @mode.setter
    def mode(self, values: np.ndarray | int) -> None:
        self._body[self._modes] = values

    def to_bytes(self) -> bytes:
        """Return what is sent."""
        return self.buffer.tobytes()

    def copy(self) -> Self:
        """Return the same message in bytes of its own."""
        return type(self)(self.to_bytes())

    @property
    def crc(self) -> int:
        """The checksum that it carries."""
        return int(self._words[-1])

    def seal(self) -> None:
        """Write the checksum of what it says."""
        self._words[-1] = self.computed_crc()

    def computed_crc(self) -> int:
        """Return the checksum of what it says, padding taken as zero."""
        words, split = self._words, self._SPLIT
        shared = self._body[4 * split : 4 * split + 2].view("<u2")[0]
        mode = self._body[self._FIRST_MODE]
        return crc_of_words(np.concatenate([words[:split], [shared, mode], words[split + 1 : -1]], dtype=np.uint32))

    def is_sound(self) -> bool:
        """Return whether it carries the checksum of what it says."""
        return self.crc == self.computed_crc()


class LowCmd(_Message):
    """A command to all motors: torque = kp (q - position) + kd (dq - velocity) + tau.

    Args:
        content: Bytes as received; a message of zeros by default.

    Attributes:
        buffer: (1004,) uint8.
        q: (35,) float32 view of the targets [rad].
        dq: (35,) target velocities [rad/s].
        tau: (35,) torques [Nm].
        kp: (35,) [Nm/rad].
        kd: (35,) [Nms/rad].

    Raises:
        ValueError: Bytes of another size or encoding.
    """

    SIZE, _FIRST_MODE, _SPLIT = 1004, 2, 0

    def __init__(self, content: bytes | None = None) -> None:
        super().__init__(content)
        motors = self._words[: 7 * NUM_SLOTS].view("<f4").reshape(NUM_SLOTS, 7)
        self.q, self.dq, self.tau, self.kp, self.kd = (motors[:, column] for column in range(1, 6))
        self._modes = np.append(2, 28 * np.arange(1, NUM_SLOTS))

    @property
    def mode_pr(self) -> int:
        """How ankles and waist are commanded, see ``MODE_PR``."""
        return int(self._body[0])

    @mode_pr.setter
    def mode_pr(self, value: int) -> None:
        self._body[0] = value

    @property
    def mode_machine(self) -> int:
        """Which robot it is for, see ``MODE_MACHINE_29``."""
        return int(self._body[1])

    @mode_machine.setter
    def mode_machine(self, value: int) -> None:
        self._body[1] = value


class LowState(_Message):
    """What the robot says of itself.

    Args:
        content: Bytes as received; a message of zeros by default.

    Attributes:
        buffer: (2092,) uint8.
        quat_wxyz: (4,) float32 view of the pelvis orientation.
        gyro: (3,) angular velocity of the pelvis in its own frame [rad/s].
        accelerometer: (3,) [m/s2].
        rpy: (3,) roll, pitch and yaw [rad].
        q: (35,) positions [rad].
        dq: (35,) velocities [rad/s].
        tau: (35,) estimated torques [Nm].
        temperature: (35, 2) int16 of the motors' surface and winding [Celsius].
        remote: (40,) uint8 of the wireless remote.

    Raises:
        ValueError: Bytes of another size or encoding.
    """

    SIZE, _FIRST_MODE, _SPLIT = 2092, 70, 17

    def __init__(self, content: bytes | None = None) -> None:
        super().__init__(content)
        floats = self._words[4:17].view("<f4")
        self.quat_wxyz, self.gyro, self.accelerometer, self.rpy = np.split(floats, (4, 7, 10))
        motors = self._words[18 : 18 + 14 * NUM_SLOTS].reshape(NUM_SLOTS, 14)  # without the mode, then the next's mode
        numbers = motors.view("<f4")
        self.q, self.dq, self.ddq, self.tau = (numbers[:, column] for column in range(4))
        self.temperature = motors[:, 4:5].view("<i2")
        self.voltage = numbers[:, 5]
        self.remote = self._body[2028:2068]
        self._modes = np.append(70, 68 + 56 * np.arange(1, NUM_SLOTS))

    @property
    def tick(self) -> int:
        """A counter that the robot advances."""
        return int(self._words[3])

    @tick.setter
    def tick(self, value: int) -> None:
        self._words[3] = value & 0xFFFFFFFF

    @property
    def mode_machine(self) -> int:
        """Which robot it is, see ``MODE_MACHINE_29``."""
        return int(self._body[9])

    @mode_machine.setter
    def mode_machine(self, value: int) -> None:
        self._body[9] = value

    @property
    def mode_pr(self) -> int:
        """How ankles and waist are commanded."""
        return int(self._body[8])

    @mode_pr.setter
    def mode_pr(self, value: int) -> None:
        self._body[8] = value

    def is_finite(self) -> bool:
        """Return whether attitude and joints are finite numbers, and the attitude is a rotation."""
        numbers = (self.quat_wxyz, self.gyro, self.accelerometer, self.q[:NUM_JOINTS], self.dq[:NUM_JOINTS])
        if not all(np.isfinite(values).all() for values in numbers):
            return False
        return abs(float(self.quat_wxyz @ self.quat_wxyz) - 1.0) < 0.02
