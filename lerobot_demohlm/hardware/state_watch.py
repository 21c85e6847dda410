"""LowState messages as they arrive -> the newest one that can be believed, and what is odd about the robot.

A message with a wrong checksum, with numbers that are not finite, or with a tick that does not advance says nothing:
the last good one grows older, and the watchdog on its age does the rest.
"""

import math
import time

import numpy as np

from gym_demohlm.control import features
from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowState
from lerobot_demohlm.hardware.limits import Limits

GRAVITY = 9.81  # m/s2
_IMU_BLEND_S = 1.0  # over which the angle between both gravities is averaged
_MOVING = 0.2  # rad/s: an encoder whose joint turns this fast does not say the same twice
_OFF = 0.15  # rad: nor one whose joint is sent this far away
_OUTSIDE = 0.05  # rad: what a joint may be outside its range, by the error of its zero
_BEHIND = 1000  # ticks: a counter further behind than this has begun again
_AHEAD = 100_000  # ticks: a counter further ahead than this is another robot's


class StateWatch:
    """Believes or refuses what a robot says.

    Args:
        limits: What it may say.

    Attributes:
        state: The newest message believed; None before the first.
        time_ns: When it arrived.
        refused: Messages not believed: by "crc", "numbers", "tick".
        imu_error: Angle between gravity by attitude and by accelerometer, averaged [rad].
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self.state: LowState | None = None
        self.time_ns = 0
        self.refused = {"crc": 0, "numbers": 0, "tick": 0}
        self.imu_error = 0.0
        self._mode_machine: int | None = None
        self._same_since_ns = np.zeros(NUM_JOINTS, np.int64)

    @property
    def age_s(self) -> float:
        """Age of the newest message that was believed [s]; infinite before the first."""
        return math.inf if self.state is None else 1e-9 * (time.monotonic_ns() - self.time_ns)

    def take(self, content: bytes, now_ns: int | None = None, *, may_restart: bool = True) -> bool:
        """Take in a message; returns whether it is believed.

        Args:
            content: Its bytes.
            now_ns: When it arrived (``time.monotonic_ns``); now by default.
            may_restart: Whether a tick far from the last one is a robot that has begun again. While its motors hold, it
                is another robot.
        """
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        try:
            state = LowState(content)
        except ValueError:
            self.refused["crc"] += 1
            return False
        if not state.is_sound():
            self.refused["crc"] += 1
            return False
        if not state.is_finite():
            self.refused["numbers"] += 1
            return False
        before = self.state
        if before is not None and not _advanced(before.tick, state.tick, may_restart):
            self.refused["tick"] += 1
            return False
        if before is None:
            self._mode_machine = state.mode_machine
            self._same_since_ns[:] = now_ns
        else:
            moved = state.q[:NUM_JOINTS] != before.q[:NUM_JOINTS]
            self._same_since_ns[moved] = now_ns
            self._compare_gravity(state, 1e-9 * (now_ns - self.time_ns))
        self.state, self.time_ns = state, now_ns
        return True

    @property
    def mode_machine(self) -> int:
        """What the robot said of itself first; 0 before it has."""
        return self._mode_machine or 0

    @property
    def tilt(self) -> float:
        """How far the pelvis leans [rad]; 0 before the first message."""
        if self.state is None:
            return 0.0
        quat = self.state.quat_wxyz.astype(np.float64)
        _, x, y, _ = quat / np.linalg.norm(quat)
        return math.acos(min(max(1.0 - 2.0 * (x * x + y * y), -1.0), 1.0))

    def too_fast(self) -> np.ndarray:
        """Return which joints turn too fast, (29,) bool."""
        if self.state is None:
            return np.zeros(NUM_JOINTS, bool)
        return np.abs(self.state.dq[:NUM_JOINTS]) > self._limits.speed

    def outside(self) -> np.ndarray:
        """Return which joints are outside their ranges, (29,) bool."""
        if self.state is None:
            return np.zeros(NUM_JOINTS, bool)
        q, ranges = self.state.q[:NUM_JOINTS], self._limits.ranges
        return (q < ranges[:, 0] - _OUTSIDE) | (q > ranges[:, 1] + _OUTSIDE)

    def hottest(self) -> tuple[float, int]:
        """Return the highest temperature of a motor [Celsius], and which joint it is."""
        if self.state is None:
            return 0.0, 0
        each = self.state.temperature[:NUM_JOINTS].max(axis=1)
        return float(each.max()), int(each.argmax())

    def stuck(self, targets: np.ndarray | None) -> np.ndarray:
        """Return which encoders say the same for too long though their joints should move, (29,) bool.

        Args:
            targets: (29,) where the joints are sent [rad]; None while they are not held.
        """
        if self.state is None:
            return np.zeros(NUM_JOINTS, bool)
        moves = np.abs(self.state.dq[:NUM_JOINTS]) > _MOVING
        if targets is not None:
            moves |= np.abs(targets - self.state.q[:NUM_JOINTS]) > _OFF
        return moves & (1e-9 * (self.time_ns - self._same_since_ns) > self._limits.stuck_s)

    def changed_machine(self) -> bool:
        """Return whether the robot says that it is another than it was."""
        return self.state is not None and self.state.mode_machine != self._mode_machine

    def _compare_gravity(self, state: LowState, dt: float) -> None:
        up = state.accelerometer.astype(np.float64)
        length = float(np.linalg.norm(up))
        if not 0.5 * GRAVITY < length < 1.5 * GRAVITY:
            return
        down = features.gravity(state.quat_wxyz.astype(np.float64)[None])[0]
        angle = math.acos(min(max(float(-down @ up) / length, -1.0), 1.0))
        self.imu_error += min(dt / _IMU_BLEND_S, 1.0) * (angle - self.imu_error)


def _advanced(before: int, now: int, may_restart: bool) -> bool:
    """Return whether a counter of 32 bits has advanced; one that begins again does where it may."""
    ahead = (now - before) & 0xFFFFFFFF
    return 0 < ahead < (2**32 - _BEHIND if may_restart else _AHEAD)
