"""Messages of several browsers, at their own rates -> the newest controls of the one that drives, and their age."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gym_demohlm.robot.g1 import SIDES
from lerobot_demohlm.teleop.clutch import Controls
from lerobot_demohlm.teleop.smoothing import PoseSmoother, SmoothingSettings
from lerobot_demohlm.teleop.web import protocol

DRIVER_REST_S = 0.5  # after which another operator's browser may take over
SMOOTHING = SmoothingSettings()


class Latencies:
    """How long it takes from a page's message to the command that it becomes part of."""

    def __init__(self) -> None:
        self._pending: list[float] = []  # arrived, and not looked at yet [s]
        self._taken: list[float] = []  # looked at for the command that comes next [s]
        self._done: deque[float] = deque(maxlen=5000)  # [ms]
        self._lock = threading.Lock()

    def arrived(self, sent_s: float) -> None:
        """Note a message that was sent at this time [s]."""
        with self._lock:
            self._pending.append(sent_s)

    def taken(self) -> None:
        """Note that all that has arrived makes the next command."""
        with self._lock:
            self._taken, self._pending = self._pending, []  # those of a command that was never made do not count

    def applied(self, now_s: float) -> None:
        """Note that the first tick of that command is done."""
        with self._lock:
            self._done.extend(1e3 * (now_s - sent) for sent in self._taken if 0.0 <= now_s - sent < 10.0)
            self._taken.clear()

    def summary(self) -> dict[str, float]:
        """Return median and 99th percentile [ms] of the messages counted."""
        with self._lock:
            values = np.array(self._done)
        if len(values) == 0:
            return {"count": 0}
        p50, p99 = np.percentile(values, [50, 99])
        return {"count": len(values), "p50_ms": round(float(p50), 1), "p99_ms": round(float(p99), 1)}


class Inputs:
    """The newest controls, and whose they are: one browser drives at a time.

    Args:
        clock: Returns the time [s].
        smoothing: How poses of hands and head are smoothed, at the rate at which they come; None for not at all.

    Attributes:
        device: Kind of device that drives.
        latencies: Of the messages of the browser that drives.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        smoothing: SmoothingSettings | None = SMOOTHING,
    ) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._controls, self._heard = Controls(), -np.inf
        self._driver: object | None = None
        self._changes = 0  # of who drives
        self._active_at = -np.inf
        self.device = "none"
        self.latencies = Latencies()
        self._smoothers = {name: PoseSmoother(smoothing) for name in ("left", "right", "head")}

    def put(self, source: object, message: protocol.Input) -> bool:
        """Take in a message of a browser; returns whether that browser drives."""
        with self._lock:
            now = self._clock()
            resting = now - self._active_at > DRIVER_REST_S
            active = message.controls.active
            if self._driver is None or (source is not self._driver and resting and active):
                self._driver = source
                self._changes += 1
                for smoother in self._smoothers.values():
                    smoother.reset()
            if source is not self._driver:
                return False
            if active:
                self._active_at = now
            time_s = message.sent_s if message.sent_s > 0.0 else now
            controls = replace(self._smoothed(message.controls, time_s), driver=self._changes)
            self._controls, self._heard, self.device = controls, now, message.device
            if message.sent_s > 0.0:
                self.latencies.arrived(message.sent_s)
            return True

    def _smoothed(self, controls: Controls, time_s: float) -> Controls:
        """Return controls with smoothed poses; a hand that is engaged anew begins where it is."""
        hands = {}
        for side, hand, before in zip(SIDES, controls.hands, self._controls.hands, strict=True):
            smoother = self._smoothers[side]
            if hand.pose is None or hand.engaged != before.engaged:
                smoother.reset()
            hands[side] = hand if hand.pose is None else replace(hand, pose=smoother(hand.pose, time_s))
        head = controls.head
        if head is not None:
            head = self._smoothers["head"](head, time_s)
        return replace(controls, head=head, **hands)

    def gone(self, source: object) -> None:
        """Forget a browser that has left: if it drove, nobody does."""
        with self._lock:
            if self._driver is source:
                self._driver, self._controls, self._heard, self.device = None, Controls(), -np.inf, "none"

    def latest(self) -> Controls:
        """Return the newest controls with their age, for the next command."""
        with self._lock:
            self.latencies.taken()
            return replace(self._controls, age_s=float(min(self._clock() - self._heard, 1e6)))
