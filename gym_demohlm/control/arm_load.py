"""The joints of both arms -> how they and what the hands carry shift the robot's weight, without a loop over links.

Every joint turns what it carries by a matrix that is linear in (1, cos q, sin q), so the position of whatever point an
arm carries is linear in the products of one of these three of each joint: one table holds the arms' statics.
"""

import numpy as np

from gym_demohlm.arithmetic import ExactProduct
from gym_demohlm.robot import g1

NUM_JOINTS = 4  # of one arm: shoulder pitch, roll, yaw, elbow; the wrists move little mass
TABLE_SHAPE = (3**NUM_JOINTS, 6)
HAND = (0.1, 0.0, 0.0)  # m from the last wrist joint: where a hand carries what it carries
GRAVITY = 9.81  # m/s2
MIRROR = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, 1.0]])  # left, right: the right arm as a left one
SIDEWAYS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])
_HOME = g1.HOME[15:].reshape(2, 7)[:, :NUM_JOINTS]
_MOTORS = [g1.motor(joint) for joint in g1.ARM_JOINTS[:NUM_JOINTS]]
STIFFNESS = np.array([motor.stiffness for motor in _MOTORS])
DAMPING = np.array([motor.damping for motor in _MOTORS])
LARGEST = 3.0  # kg
WEIGHING_S = 0.6  # s: time constant of the estimate, for an arm stretched out
SWINGING = 1.0  # rad/s: an arm that moves faster is weighed more slowly
LITTLE = 4.0  # (Nm/kg)2: a lever that tells little; hanging arms keep what was found before


def _products(factors: np.ndarray) -> np.ndarray:
    """Return all products of one of the three factors of each joint, (..., 4, 3) -> (..., 81)."""
    products = factors[..., 0, :]
    for joint in range(1, NUM_JOINTS):
        products = products[..., :, None] * factors[..., joint, None, :]
        products = products.reshape(*products.shape[:-2], -1)
    return products


def _factors(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (1, cos q, sin q) and its derivative for each joint, (..., 4) [rad] -> (..., 4, 3) each."""
    joints = np.ascontiguousarray(joints)
    one, cos, sin = np.ones_like(joints), np.cos(joints), np.sin(joints)
    return np.stack([one, cos, sin], axis=-1), np.stack([0.0 * one, -sin, cos], axis=-1)


def basis(joints: np.ndarray) -> np.ndarray:
    """Return what the tables are coefficients of, (..., 4) [rad] -> (..., 81)."""
    return _products(_factors(joints)[0])


class ArmLoad:
    """Statics of the arms.

    Args:
        table: (81, 6) first moment of the left arm's mass [kg m] and position of what its hand carries [m] in the torso
            frame, as coefficients of ``basis``.
    """

    def __init__(self, table: np.ndarray) -> None:
        self.table = np.array(table, dtype=np.float64)
        self.product = ExactProduct(self.table, bound=1.0)  # a product of sines and cosines is no larger
        self.home = self._moment(_HOME[None], np.zeros((1, 2)))[0]

    def __call__(self, arms: np.ndarray, carried: np.ndarray) -> np.ndarray:
        """Return the moment [kg m] in the torso frame that arms and loads add to that of empty arms at home.

        Args:
            arms: (N, 8) the first four joints of the left and of the right arm [rad].
            carried: (N, 2) in the left and the right hand [kg].

        Returns:
            (N, 3).
        """
        return self._moment(arms.reshape(len(arms), 2, NUM_JOINTS), carried) - self.home

    def _moment(self, arms: np.ndarray, carried: np.ndarray) -> np.ndarray:
        """Return the moment of both arms, (N, 2, 4) and (N, 2) -> (N, 3)."""
        of_each = self.product(basis(arms * MIRROR))  # (N, 2, 6)
        return ((of_each[..., :3] + carried[..., None] * of_each[..., 3:]) * SIDEWAYS).sum(axis=1)

    def weigh(
        self, carried: np.ndarray, targets: np.ndarray, q: np.ndarray, dq: np.ndarray, down: np.ndarray, dt: float
    ) -> np.ndarray:
        """Move an estimate of what the hands carry towards what the arms' servos hold up.

        Their torques, less those that hold the empty arms, are ``c m`` in each joint for a mass m in the hand, where c
        is how far gravity turns the joint: m follows the gradient of the squared difference.

        Args:
            carried: (N, 2) the estimate so far, of the left and the right hand [kg].
            targets: (N, 8) of the servos, the first four joints of both arms [rad].
            q: (N, 8) their positions [rad].
            dq: (N, 8) their velocities [rad/s].
            down: (N, 3) direction of gravity in the torso frame.
            dt: Time since the last estimate [s].

        Returns:
            (N, 2).
        """
        shape = (len(q), 2, NUM_JOINTS)
        torque = STIFFNESS * (targets - q).reshape(shape) - DAMPING * dq.reshape(shape)
        values, slopes = _factors(q.reshape(shape) * MIRROR)
        factors = np.tile(values[:, :, None], (1, 1, NUM_JOINTS, 1, 1))  # (N, 2, 4, 4, 3): a row for each derivative
        for joint in range(NUM_JOINTS):
            factors[:, :, joint, joint] = slopes[:, :, joint]
        turned = self.product(_products(factors))  # (N, 2, 4, 6): how each joint moves moment and hand
        weight = -GRAVITY * (down[:, None] * SIDEWAYS)[:, :, None]  # (N, 2, 1, 3)
        own, lever = (weight * turned[..., :3]).sum(axis=3), (weight * turned[..., 3:]).sum(axis=3)
        left_over = torque * MIRROR - own - lever * carried[..., None]
        step = (left_over * lever).sum(axis=2) / ((lever * lever).sum(axis=2) + LITTLE)
        step = step / (1 + (dq.reshape(shape) ** 2).sum(axis=2) / SWINGING**2)
        return np.clip(carried + dt / WEIGHING_S * step, 0.0, LARGEST)
