"""One look at the objects of a task, whoever took it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Look:
    """One look at the objects.

    Attributes:
        T_camera_object: (k, 4, 4) in the frame ``head_camera``.
        valid: (k,) whether each was seen.
        age_s: (k,) since each was seen [s].
        time_ns: When the robot looked (``time.monotonic_ns``).
    """

    T_camera_object: np.ndarray
    valid: np.ndarray
    age_s: np.ndarray
    time_ns: int
