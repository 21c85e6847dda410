"""Every physics step of walking robots -> how fast they move and turn on average over a gait cycle.

The pelvis of a walking robot sways with its steps. The average over a whole cycle leaves the sway out: it shows how
well the robot follows the commanded velocity.
"""

import math

import numpy as np

from gym_demohlm.control.features import gravity
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT


class CycleMean:
    """The last gait cycle of every robot.

    Args:
        simulation: Whose robots.
        period_s: Of the gait [s].

    Attributes:
        steps: Environment steps until a cycle lies behind a robot.
    """

    def __init__(self, simulation: Simulation, period_s: float) -> None:
        self._simulation = simulation
        self.steps = math.ceil(period_s / STEP_DT)
        samples = max(1, round(period_s / simulation.model.opt.timestep))
        self._seen = np.full((simulation.num_worlds, samples, 3), np.nan)

    def add(self) -> None:
        """Take in the physics steps of the last environment step."""
        worlds, velocity = self._simulation.readings("pelvis_linvel")  # (n, steps, 3), in the world
        quat, gyro = (self._simulation.readings(name)[1] for name in ("pelvis_quat", "pelvis_gyro"))
        w, x, y, z = np.moveaxis(quat, -1, 0)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        cos, sin = np.cos(heading), np.sin(heading)
        down = gravity(quat.reshape(-1, 4)).reshape(gyro.shape)
        forward = cos * velocity[..., 0] + sin * velocity[..., 1]
        sideways = cos * velocity[..., 1] - sin * velocity[..., 0]
        newest = np.stack([forward, sideways, -(down * gyro).sum(axis=-1)], axis=-1)
        kept = np.concatenate([self._seen[worlds], newest], axis=1)
        self._seen[worlds] = kept[:, -self._seen.shape[1] :]

    def mean(self) -> np.ndarray:
        """Return forward and sideways velocity in the heading frame [m/s] and yaw rate [rad/s], (N, 3).

        NaN for robots that have not lived for a cycle.
        """
        return self._seen.mean(axis=1)
