"""What a perceiver says of the objects of some worlds, and what every perceiver does."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gym_demohlm.simulation import Simulation

PERCEPTION_STREAM = 7  # first number of a seed sequence, so that its draws are no other stream's
UNSEEN = np.array([1.0, 0.0, 0.0])
"""Where an object is said to be before it was seen, in the frame ``head_camera`` [m]."""


@dataclass(frozen=True, kw_only=True)
class PoseEstimate:
    """Where objects seem to be; rows are worlds, columns the task's objects in their order.

    Attributes:
        T_camera_object: (n, k, 4, 4) poses in the frame ``head_camera``, of equivalent ones the nearest to the
            camera's heading.
        valid: (n, k) whether the newest frame in which the object was looked for showed it; furniture is not looked for
            in every frame. Where it did not, the last pose is held in odometry coordinates.
        age_s: (n, k) time since a frame showed it [s]; infinite where none has.
        inliers: (n, k) share of its depth pixels that lie on the estimated object; 1 for exact poses.
    """

    T_camera_object: np.ndarray
    valid: np.ndarray
    age_s: np.ndarray
    inliers: np.ndarray

    def environment_state(self) -> np.ndarray:
        """Return the observation (n, 9k) float32, see ``gym_demohlm.envs.observation``."""
        T = self.T_camera_object
        columns = [T[..., :3, 3], T[..., :3, 0], T[..., :3, 1]]
        return np.concatenate(columns, axis=-1).reshape(len(T), -1).astype(np.float32)

    def position(self, index: int) -> np.ndarray:
        """Return where an object is in the frame ``head_camera`` (n, 3) [m], for the gaze."""
        return self.T_camera_object[:, index, :3, 3].copy()


class Perceiver(Protocol):
    """A source of poses for the worlds of one simulation."""

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Forget everything about some worlds, whose episodes begin.

        Args:
            rows: (n,) the worlds.
            seeds: One each, of all that is random in what they see.
        """
        ...

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Look at some worlds (n,), once a step of 0.1 s."""
        ...

    def close(self) -> None:
        """Give back what it holds, such as a graphics context."""
        ...


def faults_of(perceiver: Perceiver, row: int) -> dict[str, int]:
    """Return how often what went wrong in the episode of a world, by its reason; only a server's poses can."""
    counted = getattr(perceiver, "faults", None)
    return {} if counted is None else counted(row)
