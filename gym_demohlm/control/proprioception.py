"""What a robot senses of itself: the input of a whole-body controller."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Proprioception:
    """Attitude and joints of M robots at one moment.

    Attributes:
        quat_wxyz: (M, 4) orientation of the pelvis in the world.
        gyro: (M, 3) angular velocity of the pelvis in the pelvis frame [rad/s].
        q: (M, 29) positions of ``g1.BODY_JOINTS`` [rad].
        dq: (M, 29) velocities of ``g1.BODY_JOINTS`` [rad/s].
    """

    quat_wxyz: np.ndarray
    gyro: np.ndarray
    q: np.ndarray
    dq: np.ndarray

    def __len__(self) -> int:
        """Return the number of robots."""
        return len(self.quat_wxyz)

    def __getitem__(self, rows: np.ndarray | slice) -> "Proprioception":
        """Return what some of the robots sense, in the order of ``rows``."""
        return Proprioception(quat_wxyz=self.quat_wxyz[rows], gyro=self.gyro[rows], q=self.q[rows], dq=self.dq[rows])
