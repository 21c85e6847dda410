"""Drawn pictures of objects that wear AprilTags -> their poses, as most laboratories have them."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import camera
from gym_demohlm.perception.picture import photographed
from gym_demohlm.perception.rgbd import mounting_of
from gym_demohlm.perception.seeing import Eyes, SeeingPerceiver, Sighting
from gym_demohlm.perception.settings import FOCAL_OF_DEGREE, PerceptionSettings
from gym_demohlm.perception.tag_layout import Tag, is_tag, tagged_model
from gym_demohlm.perception.tags import TagFinder, object_pose
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task

_MARGIN = 50.0  # px around an object in which its tags are looked for
_FOLLOWED_S = 0.35  # an object lost for longer is looked for in the whole image


@dataclass
class _Memory:
    """What is known of each object."""

    sightings: list[Sighting | None]


class AprilTagPerceiver(SeeingPerceiver):
    """Looks for tags in pictures of the head camera.

    Args:
        task: The task.
        num_worlds: N of the simulation.
        settings: ``camera_error`` and ``mesh_scale``, here of the tags, are read.

    Raises:
        SceneError: This machine has nothing to draw with; at the first look.
    """

    def __init__(self, task: Task, num_worlds: int, settings: PerceptionSettings) -> None:
        super().__init__(task, num_worlds, mounting_of(settings))
        self._settings, self._finder = settings, TagFinder()
        self._tags: tuple[tuple[Tag, ...], ...] = ()
        self._plates: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]] = []

    def _begin_world(self, eyes: Eyes, row: int) -> None:
        eyes.memory = _Memory([None] * len(self._task.objects))

    def _open(self, sim: Simulation) -> VisualModel:
        model, self._printed = tagged_model(sim.scene)
        self._know({})
        worn = is_tag(model)
        self._plates = []
        for entry, tags in zip(self._task.objects, self._printed, strict=True):
            geoms = np.array([model.geom(tag.plate).id for tag in tags])
            fronts = np.array([tag.T_object_tag[:3, 3] for tag in tags])
            self._plates.append((entry.name, geoms, model.geom_pos[geoms].copy(), fronts))
        return VisualModel(model, geoms=np.flatnonzero(~worn))

    def _wear(self, visual: VisualModel, sim: Simulation, row: int) -> None:
        """Move tags with the faces of objects that are larger or smaller; who stuck them there measured where."""
        super()._wear(visual, sim, row)
        if not sim.variation:
            return
        conditions = sim.conditions(row)
        sizes = {name: sim.scene.size(name, conditions) for name in sim.scene.loose}
        for name, geoms, middles, fronts in self._plates:  # a plate stays as thick
            visual.model.geom_pos[geoms] = middles + (sizes.get(name, 1.0) - 1.0) * fronts
        self._know(sizes)

    def _know(self, sizes: Mapping[str, float]) -> None:
        """Note where the robot takes the tags to be on objects of some sizes, over the plain ones."""
        scale = self._settings.mesh_scale
        self._tags = tuple(
            tuple(_scaled(tag, scale, sizes.get(entry.name, 1.0)) for tag in worn)
            for entry, worn in zip(self._task.objects, self._printed, strict=True)
        )

    def _look(
        self, visual: VisualModel, eyes: Eyes, T_odom_optical: np.ndarray, palms: dict[str, np.ndarray]
    ) -> list[Sighting | None]:
        memory = eyes.memory
        assert isinstance(memory, _Memory)
        T_optical_odom = poses.invert(T_odom_optical)
        expected = [None if entry is None else T_optical_odom @ entry.T_odom_object for entry in memory.sightings]
        window = self._window(expected, memory.sightings, visual.intrinsics)
        grey = photographed(cv2.cvtColor(visual.rgb(window), cv2.COLOR_RGB2GRAY), eyes.rng)
        corners = self._finder.corners(grey, window)
        known = visual.intrinsics.scaled(1.0 + FOCAL_OF_DEGREE * self._settings.camera_error)
        for k, worn in enumerate(self._tags):
            found, last = object_pose(worn, corners, known, expected[k]), memory.sightings[k]
            if found is not None:
                T, share = found
                memory.sightings[k] = Sighting(T_odom_object=T_odom_optical @ T, valid=True, age_s=0.0, inliers=share)
            elif last is not None:
                memory.sightings[k] = Sighting(
                    T_odom_object=last.T_odom_object, valid=False, age_s=last.age_s + eyes.dt_s, inliers=last.inliers
                )
        return list(memory.sightings)

    def _window(
        self, expected: list[np.ndarray | None], sightings: list[Sighting | None], intrinsics: camera.Intrinsics
    ) -> camera.Window:
        """Return the part of the image in which the tags should be; all of it where an object is lost."""
        everything, uv = camera.whole(intrinsics), []
        for T, sighting, worn in zip(expected, sightings, self._tags, strict=True):
            if T is None or sighting is None or sighting.age_s > _FOLLOWED_S:
                return everything
            p_optical = poses.transform(T, np.concatenate([tag.corners for tag in worn]))
            if p_optical[:, 2].min() < 0.1:
                return everything
            uv.append(intrinsics.project(p_optical))
        return camera.window_around(np.concatenate(uv), _MARGIN, intrinsics) or everything


def _scaled(tag: Tag, factor: float, size: float) -> Tag:
    """Return a tag as it is known on an object of a size, where all known lengths are off by a factor."""
    T = tag.T_object_tag.copy()
    T[:3, 3] *= factor * size
    return Tag(id=tag.id, T_object_tag=T, edge=tag.edge * factor)
