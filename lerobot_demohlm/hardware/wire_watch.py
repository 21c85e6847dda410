"""Commands as they arrive at a robot -> whether each may be carried out, and whether it is within every limit.

The robot's side of the wire: it knows nothing of who sent a command, and shares no state with the safety filter.
"""

from collections import Counter

import numpy as np

from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowCmd
from lerobot_demohlm.hardware.limits import DAMPING, Limits

_ROUNDING = 1e-5  # of float32
_NOISE = 1.25  # the robot's own torque, at a later state than the sender knew


class WireWatch:
    """Checks what a robot is told.

    Args:
        limits: What it may be told.
        mode_machine: Of this robot.

    Attributes:
        counts: "executed", "bad_crc", "other_machine"; and executed commands beyond a limit: "joint", "step", "gain",
            "finite", "torque".
        worst: The largest of each limit's violations, in its own unit.
    """

    def __init__(self, limits: Limits, mode_machine: int) -> None:
        self._limits, self._mode_machine = limits, mode_machine
        self.counts: Counter[str] = Counter()
        self.worst: dict[str, float] = {}
        self._last: np.ndarray | None = None

    def take(self, content: bytes, q: np.ndarray, dq: np.ndarray) -> LowCmd | None:
        """Return a command that is to be carried out; None for one that is refused.

        Args:
            content: Its bytes.
            q: (29,) where the joints are [rad].
            dq: (29,) how fast they turn [rad/s].
        """
        try:
            command = LowCmd(content)
        except ValueError:
            command = None
        if command is None or not command.is_sound():
            self.counts["bad_crc"] += 1
            return None
        if command.mode_machine != self._mode_machine:
            self.counts["other_machine"] += 1
            return None
        self.counts["executed"] += 1
        self._judge(command, q, dq)
        return command

    @property
    def violations(self) -> int:
        """Executed commands beyond a limit, each limit counted."""
        return sum(self.counts[name] for name in ("joint", "step", "gain", "finite", "torque"))

    def _judge(self, command: LowCmd, q: np.ndarray, dq: np.ndarray) -> None:
        limits = self._limits
        target, kp, kd = (values[:NUM_JOINTS].astype(np.float64) for values in (command.q, command.kp, command.kd))
        if not all(np.isfinite(values).all() for values in (target, kp, kd, command.tau, command.dq)):
            self._note("finite", 1.0)
            return
        self._note("gain", float(np.maximum(kp - limits.max_kp, kd - max(limits.max_kd, DAMPING)).max()))
        held = kp > 0.0
        if not held.any():
            self._last = None
            return
        low, high = limits.ranges.T
        self._note("joint", float(np.maximum(low - target, target - high)[held].max()))
        if self._last is not None:
            self._note("step", float((np.abs(target - self._last) - limits.step).max()))
        self._last = target
        torque = np.abs(kp * (target - q) - kd * dq)
        self._note("torque", float((torque / limits.torque - _NOISE).max()))

    def _note(self, name: str, excess: float) -> None:
        if excess > _ROUNDING:
            self.counts[name] += 1
            self.worst[name] = max(self.worst.get(name, 0.0), excess)
