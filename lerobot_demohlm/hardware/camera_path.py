"""What robot and servos measured lately -> where the head camera was at any moment of the last second.

A picture is some ten milliseconds old when it comes, and the head has turned since it was taken.
"""

import bisect
import threading
from collections import deque
from collections.abc import Callable
from typing import Self

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import torso_camera
from lerobot_demohlm.hardware.slots import Slot

KEPT = 400  # measurements: more than a second of the robot's, eight seconds of the servos'
PERIOD_S = 0.004  # between looks for new ones
_Samples = deque[tuple[int, np.ndarray]]


class CameraPath:
    """Follows the head camera; as a context, in a thread of its own, which goes on while others wait for pictures.

    Args:
        state: Slot of the record "state".
        servos: Slot of the record "servos"; while nothing is in it, the neck is taken to be at zero.
    """

    def __init__(self, state: Slot, servos: Slot) -> None:
        self._state, self._servos = state, servos
        self._torso: _Samples = deque(maxlen=KEPT)  # times [ns] and T_odometry_torso (4, 4)
        self._neck: _Samples = deque(maxlen=KEPT)  # times [ns] and angles (2,) [rad]
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._follow, name="camera path", daemon=True)

    def __enter__(self) -> Self:
        """Begin to follow."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self._over.set()
        self._thread.join()

    def at(self, time_ns: int) -> np.ndarray | None:
        """Return ``T_odometry_camera`` (4, 4) at a time (``time.monotonic_ns``).

        After the newest measurement that one counts. None before the oldest one of the robot, or before any.
        """
        self._note()
        with self._lock:
            torso, neck = list(self._torso), list(self._neck)
        if not torso or time_ns < torso[0][0]:
            return None
        angles = _between(neck, time_ns, lambda a, b, u: (1.0 - u) * a + u * b) if neck else np.zeros(2)
        return _between(torso, time_ns, poses.interpolate) @ torso_camera(angles)

    def _follow(self) -> None:
        while not self._over.wait(PERIOD_S):
            self._note()

    def _note(self) -> None:
        """Take in what was measured since."""
        with self._lock:
            for slot, samples, field in (
                (self._state, self._torso, "T_odometry_torso"),
                (self._servos, self._neck, "neck"),
            ):
                reading = slot.read()
                if reading is not None and (not samples or reading.time_ns > samples[-1][0]):
                    samples.append((reading.time_ns, reading.value[field]))


def _between(
    samples: list[tuple[int, np.ndarray]],
    time_ns: int,
    interpolate: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
) -> np.ndarray:
    """Return a value at a time, between the two measurements beside it; the first or last one outside of them."""
    after = bisect.bisect_right(samples, time_ns, key=lambda sample: sample[0])
    if after in (0, len(samples)):
        return samples[min(after, len(samples) - 1)][1]
    (begin_ns, first), (end_ns, last) = samples[after - 1 : after + 1]
    return interpolate(first, last, (time_ns - begin_ns) / (end_ns - begin_ns))
