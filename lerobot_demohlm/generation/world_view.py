"""One world of a simulation, as the stages of generation see it: poses, forces, and the verdicts of the task."""

from dataclasses import dataclass, field

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation


@dataclass(frozen=True, kw_only=True)
class WorldView:
    """A view of one world; everything it returns is a copy.

    Attributes:
        sim: The simulation.
        index: Which of its worlds.
        ik: Inverse kinematics of the robot, shared: it remembers nothing.
        noise: (23,) what the last command carried when it was executed, beyond what was planned.
    """

    sim: Simulation
    index: int
    ik: WholeBodyIK
    noise: np.ndarray = field(default_factory=lambda: np.zeros(command.SIZE))

    def pose(self, name: str) -> np.ndarray:
        """Return the pose (4, 4) of a frame in the world."""
        return self.sim.pose(name)[self.index]

    def start_pose(self, name: str) -> np.ndarray:
        """Return the pose (4, 4) in which a tracked object began."""
        return self.sim.start_pose(name)[self.index]

    def hands(self) -> np.ndarray:
        """Return the measured poses (2, 4, 4) of the palms."""
        return np.stack([self.pose(f"{side}_palm") for side in g1.SIDES])

    def command(self) -> np.ndarray:
        """Return the last command (23,) as planned: the next is planned from it, so that noise does not add up."""
        return self.sim.command[self.index] - self.noise

    def joint_positions(self) -> np.ndarray:
        """Return the body joints (29,) [rad]."""
        return self.sim.joint_positions[self.index]

    def contact_force(self, hand: str, name: str) -> float:
        """Return the normal force between a hand and an object [N]."""
        return float(self.sim.contact_force(hand, name)[self.index])
