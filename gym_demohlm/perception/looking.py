"""What eyes have not seen yet -> where the neck looks: around, for things that are nowhere near its target.

CarryBox's goal may stand beside the robot, where a neck that keeps the box in view never shows it. So the neck glances
to the right and to the left, rests on its target, and does so again until everything was seen. Afterwards odometry
tells where it is.
"""

import math

import numpy as np

from gym_demohlm.arithmetic import arctan2, norm
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT

GLANCES = np.array([[-1.4, 0.4], [1.4, 0.4]])
"""(n, 2) yaw and pitch of the neck [rad]: tables on the right, and on the left."""
ARRIVED_RAD = 0.15  # from the direction of a glance, at which it is over
LONGEST_S = 2.0  # of a glance, where a bent torso keeps the neck from its direction
REST_S = 2.0  # on the target, between two rounds of glances


class LookAround:
    """Remembers how far the worlds are with their glances.

    Args:
        task: The task.
        num_worlds: N of the simulation.
    """

    def __init__(self, task: Task, num_worlds: int) -> None:
        names = [entry.name for entry in task.objects]
        self._searched = [names.index(name) for name in task.searched]
        self._glance = np.zeros(num_worlds, np.int64)  # len(GLANCES) while the neck rests on its target
        self._since_s = np.zeros(num_worlds)

    def begin(self, rows: np.ndarray) -> None:
        """Forget some worlds (n,), whose episodes begin."""
        self._glance[rows], self._since_s[rows] = 0, 0.0

    def targets(self, sim: Simulation, rows: np.ndarray, p_camera_target: np.ndarray, age_s: np.ndarray) -> np.ndarray:
        """Return where the necks of some worlds (n,) look now, (n, 3) in the frame ``head_camera`` [m].

        Args:
            sim: The worlds.
            rows: (n,) which of them, once a step of 0.1 s.
            p_camera_target: (n, 3) where the gaze target seems to be.
            age_s: (n, k) time since each object was seen [s], infinite where it never was.
        """
        found = p_camera_target.copy()
        missing = np.isinf(age_s[:, self._searched]).any(axis=1)
        if not missing.any():
            return found
        torso, camera = sim.pose("torso"), sim.pose("head_camera")
        for place in np.flatnonzero(missing):
            row = rows[place]
            R_torso_camera = torso[row, :3, :3].T @ camera[row, :3, :3]
            self._since_s[row] += STEP_DT
            if self._glance[row] < len(GLANCES):
                ahead = R_torso_camera.T @ _direction(*GLANCES[self._glance[row]])
                off = arctan2(norm(ahead[1:]), ahead[0])
                if off < ARRIVED_RAD or self._since_s[row] >= LONGEST_S:
                    self._glance[row], self._since_s[row] = self._glance[row] + 1, 0.0
            elif self._since_s[row] >= REST_S:
                self._glance[row], self._since_s[row] = 0, 0.0
            if self._glance[row] < len(GLANCES):
                found[place] = R_torso_camera.T @ _direction(*GLANCES[self._glance[row]])
        return found


def _direction(yaw: float, pitch: float) -> np.ndarray:
    """Return the unit vector (3,) on the torso along which a neck at these angles [rad] looks."""
    level = math.cos(pitch)
    return np.array([level * math.cos(yaw), level * math.sin(yaw), -math.sin(pitch)])
