"""The joint targets of both arms -> how they shift the robot's weight, exactly and without a loop over links."""

import numpy as np

from gym_demohlm.robot import g1

NUM_JOINTS = 4  # of one arm: shoulder pitch, roll, yaw, elbow; the wrists move little mass
TABLE_SHAPE = (3**NUM_JOINTS, 3)
_MIRROR = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, 1.0]])  # left, right: the right arm as a left one
_SIDEWAYS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])
_HOME = g1.HOME[15:].reshape(2, 7)[:, :NUM_JOINTS]


def basis(joints: np.ndarray) -> np.ndarray:
    """Return all products of one of (1, cos q, sin q) of each joint, (..., 4) [rad] -> (..., 81).

    Every joint turns what it carries by a matrix that is linear in (1, cos q, sin q), so whatever point an arm carries,
    its position is linear in these products.
    """
    joints = np.ascontiguousarray(joints)
    factors = np.stack([np.ones_like(joints), np.cos(joints), np.sin(joints)], axis=-1)  # (..., 4, 3)
    products = factors[..., 0, :]
    for joint in range(1, NUM_JOINTS):
        products = products[..., :, None] * factors[..., joint, None, :]
        products = products.reshape(*products.shape[:-2], -1)
    return products


class ArmLoad:
    """First moment of the arms' mass.

    Args:
        table: (81, 3) first moment [kg m] of the left arm in the torso frame as coefficients of ``basis``.
    """

    def __init__(self, table: np.ndarray) -> None:
        self.table = np.array(table, dtype=np.float64)
        self._at_home = self._moment(_HOME[None])[0]

    def __call__(self, arms: np.ndarray) -> np.ndarray:
        """Return the moment [kg m] in the torso frame that arms add to what they have at home.

        Args:
            arms: (N, 8) the first four joints of the left and of the right arm [rad].

        Returns:
            (N, 3).
        """
        return self._moment(arms.reshape(len(arms), 2, NUM_JOINTS)) - self._at_home

    def _moment(self, arms: np.ndarray) -> np.ndarray:
        """Return the moment of both arms, (N, 2, 4) -> (N, 3); summed in an order that does not depend on N."""
        of_each = basis(arms * _MIRROR) @ self.table  # (N, 2, 3): one product a robot
        return (of_each * _SIDEWAYS).sum(axis=1)
