"""The simulator's own poses as a perceiver tells them: what the others are measured against."""

from collections.abc import Sequence

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.equivalents import nearest_equivalent
from gym_demohlm.perception.estimate import PoseEstimate
from gym_demohlm.simulation import Simulation


class ExactPerceiver:
    """Says where objects are; its observation has the bits of ``observation.environment_state``."""

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Do nothing: it remembers nothing."""

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Return the exact poses in some worlds (n,)."""
        T_world_camera = sim.pose("head_camera")
        T_camera_world = poses.invert(T_world_camera)
        columns = [
            T_camera_world @ nearest_equivalent(sim.pose(entry.name), entry, T_world_camera)
            for entry in sim.task.objects
        ]
        T = np.stack(columns, axis=1)[rows]
        shape = T.shape[:2]
        return PoseEstimate(
            T_camera_object=T, valid=np.ones(shape, bool), age_s=np.zeros(shape), inliers=np.ones(shape)
        )

    def close(self) -> None:
        """Do nothing: it holds nothing."""
