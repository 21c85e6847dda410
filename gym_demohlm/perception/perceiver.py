"""A source's name -> the perceiver that says where each tracked object seems to be, in the camera's frame.

``exact`` asks the simulator. ``model`` adds a fitted error to that. ``rgbd`` draws what a D435 on the head would
measure and tracks the objects in it. ``apriltag`` looks for tags on them. ``remote`` asks a server. All answer with a
``PoseEstimate``, from which an observation and the gaze are made.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.equivalents import nearest_equivalent
from gym_demohlm.perception.estimate import Perceiver, PoseEstimate
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task


def make_perceiver(settings: str | PerceptionSettings, task: Task, num_worlds: int) -> Perceiver:
    """Return a perceiver.

    Args:
        settings: Which, and what is wrong with it; see ``PerceptionSettings.read``.
        task: The task.
        num_worlds: N of the simulation.

    Raises:
        UnknownNameError: There is no such source.
        SceneError: The source needs graphics, and this machine has none.
    """
    settings = PerceptionSettings.read(settings)
    perceiver = _source(settings, task, num_worlds)
    if not settings.is_disturbed:
        return perceiver
    from gym_demohlm.perception.disturbed import DisturbedPerceiver

    return DisturbedPerceiver(perceiver, settings, num_worlds)


def _source(settings: PerceptionSettings, task: Task, num_worlds: int) -> Perceiver:
    # Each loads what it alone needs: OpenCV, SciPy, a detector of tags, sockets.
    if settings.source == "exact":
        return ExactPerceiver()
    if settings.source == "model":
        from gym_demohlm.perception.model import ModelPerceiver

        return ModelPerceiver(task, num_worlds, Path(settings.fit) if settings.fit else None)
    if settings.source == "rgbd":
        from gym_demohlm.perception.rgbd import RgbdPerceiver, RgbdSettings

        return RgbdPerceiver(task, num_worlds, RgbdSettings.of(settings))
    if settings.source == "apriltag":
        from gym_demohlm.perception.apriltag import AprilTagPerceiver

        return AprilTagPerceiver(task, num_worlds, settings)
    from gym_demohlm.perception.remote import RemotePerceiver

    return RemotePerceiver(task, num_worlds, settings)


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
