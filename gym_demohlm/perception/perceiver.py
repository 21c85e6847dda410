"""A source's name -> the perceiver that says where each tracked object seems to be, in the camera's frame.

``exact`` asks the simulator. ``model`` adds a fitted error to that. ``rgbd`` draws what a D435 on the head would
measure and tracks the objects in it. ``apriltag`` looks for tags on them. ``remote`` asks a server. All answer with a
``PoseEstimate``, from which an observation and the gaze are made.
"""

from dataclasses import replace
from pathlib import Path

from gym_demohlm.perception.disturbance import varies
from gym_demohlm.perception.error_model import fitted_path
from gym_demohlm.perception.estimate import Perceiver
from gym_demohlm.perception.exact import ExactPerceiver
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.task import Task
from gym_demohlm.variation import NONE, Variation


def make_perceiver(
    settings: str | PerceptionSettings, task: Task, num_worlds: int, variation: Variation = NONE
) -> Perceiver:
    """Return a perceiver.

    Args:
        settings: Which, and what is wrong with it; see ``PerceptionSettings.read``.
        task: The task.
        num_worlds: N of the simulation.
        variation: Of the worlds. Where episodes draw how they see, "exact" stands for "model" if the package has errors
            that were fitted for the task, and the perceiver is a ``DisturbedPerceiver``.

    Raises:
        UnknownNameError: There is no such source.
        SceneError: The source needs graphics, and this machine has none.
    """
    settings = PerceptionSettings.read(settings)
    drawn = varies(variation)
    if drawn and settings.source == "exact" and fitted_path(task).exists():
        settings = replace(settings, source="model")
    perceiver = _source(settings, task, num_worlds)
    if not (settings.is_disturbed or drawn):
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
