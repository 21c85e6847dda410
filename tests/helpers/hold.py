"""A stand-in for the trained controller: every joint held at the home pose, arms at their targets."""

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.robot import g1


class HoldController:
    """Holds the legs; remembers a smoothed pelvis rate, so that a snapshot has something to keep."""

    def __init__(self, num_worlds: int) -> None:
        self.state = np.zeros((num_worlds, 3))

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Forget the smoothed rate of some worlds."""
        self.state[worlds] = sensed.gyro

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Return the targets (n, 29) [rad]."""
        rows = slice(None) if worlds is None else worlds
        self.state[rows] = 0.8 * self.state[rows] + 0.2 * sensed.gyro
        targets = np.tile(g1.HOME, (len(commands), 1))
        targets[:, [g1.BODY_JOINTS.index("left_ankle_pitch"), g1.BODY_JOINTS.index("right_ankle_pitch")]] += (
            0.1 * self.state[rows][:, 1:2]
        )
        targets[:, [g1.BODY_JOINTS.index(joint) for joint in g1.ARM_JOINTS]] = commands[:, command.ARMS]
        return targets
