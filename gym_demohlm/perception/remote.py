"""Drawn pictures -> a pose server elsewhere -> poses: FoundationPose, or whatever stands behind it.

A robot does not wait for its eyes. While an answer is outstanding, the last pose is held; an answer that comes late is
taken for what it is: the pose at the time of its picture.
"""

import uuid
from dataclasses import dataclass, field

import numpy as np
import zmq

from gym_demohlm.perception import d435, masks, wire
from gym_demohlm.perception.glass import Glass
from gym_demohlm.perception.meshes import ObjectMesh, known_meshes
from gym_demohlm.perception.picture import photographed
from gym_demohlm.perception.pose_client import PoseClient
from gym_demohlm.perception.rgbd import mounting_of
from gym_demohlm.perception.seeing import Eyes, SeeingPerceiver, Sighting
from gym_demohlm.perception.settings import FOCAL_OF_DEGREE, PerceptionSettings
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task

_LEAST_PATCH = 40  # px


@dataclass
class _Memory:
    """What is remembered of one world.

    Attributes:
        scale: The depth camera's factor.
        session: Of the server.
        client: Asks it.
        frame: Number of the next picture.
        sightings: What is known of each object.
    """

    scale: float
    session: str
    client: PoseClient
    frame: int = 0
    sightings: list[Sighting | None] = field(default_factory=list)


class RemotePerceiver(SeeingPerceiver):
    """Asks a pose server.

    Args:
        task: The task.
        num_worlds: N of the simulation.
        settings: ``address``, ``timeout_s``, ``masks`` and ``camera_error`` are read.

    Raises:
        SceneError: This machine has nothing to draw with, or masks are by colour and an object is grey; at the first
            look.
    """

    def __init__(self, task: Task, num_worlds: int, settings: PerceptionSettings) -> None:
        super().__init__(task, num_worlds, mounting_of(settings))
        self._settings, self._noise = settings, d435.DepthNoise()
        self._meshes: tuple[ObjectMesh, ...] = ()
        self._context = zmq.Context()

    def faults(self, row: int) -> dict[str, int]:
        """Return how often what went wrong in the episode of a world."""
        eyes = self._eyes[row]
        return dict(eyes.memory.client.faults) if eyes is not None and isinstance(eyes.memory, _Memory) else {}

    def close(self) -> None:
        """Give the graphics context back and hang up."""
        super().close()
        self._context.destroy(linger=0)

    def _begin_world(self, eyes: Eyes, row: int) -> None:
        eyes.memory = _Memory(
            scale=d435.episode_scale(self._noise, eyes.rng),
            session=uuid.uuid4().hex,
            client=PoseClient(self._context, self._settings.address, self._settings.timeout_s),
            sightings=[None] * len(self._task.objects),
        )

    def _open(self, sim: Simulation) -> VisualModel:
        self._meshes = known_meshes(sim.scene)
        if self._settings.masks == "color":
            masks.refuse_grey(self._meshes)
        visual = VisualModel(sim.model)
        self._glass = Glass(visual)
        return visual

    def _look(
        self, visual: VisualModel, eyes: Eyes, T_odom_optical: np.ndarray, palms: dict[str, np.ndarray]
    ) -> list[Sighting | None]:
        memory = eyes.memory
        assert isinstance(memory, _Memory)
        request = self._request(visual, eyes, memory, T_odom_optical, palms)
        memory.sightings = [_older(sighting, eyes.dt_s) for sighting in memory.sightings]
        told = memory.client.look(request)
        memory.frame += 1
        for k, answer in enumerate(() if told is None else told.answers):
            if answer.valid:
                assert told is not None
                T = told.request.T_odom_optical @ answer.T_optical_object
                age_s = eyes.dt_s * told.late
                memory.sightings[k] = Sighting(T_odom_object=T, valid=told.late == 0, age_s=age_s)
        return list(memory.sightings)

    def _request(
        self, visual: VisualModel, eyes: Eyes, memory: _Memory, T_odom_optical: np.ndarray, palms: dict[str, np.ndarray]
    ) -> wire.Request:
        frame, focal = visual.depth_and_ids(), visual.intrinsics.focal
        behind = self._glass.behind(frame)
        depth = d435.measure(frame.depth, self._noise, eyes.rng, scale=memory.scale, image_focal=focal, behind=behind)
        color = photographed(visual.rgb(), eyes.rng)
        found = None
        if self._settings.masks == "oracle":
            found = tuple(masks.oracle(frame.ids, mesh.geoms, eyes.rng, 1.0) for mesh in self._meshes)
        elif self._settings.masks == "color":
            found = tuple(
                masks.component_near(masks.color(color, mesh.colors), None, _LEAST_PATCH) for mesh in self._meshes
            )
        known = visual.intrinsics.scaled(1.0 + FOCAL_OF_DEGREE * self._settings.camera_error)
        return wire.Request(
            session=memory.session,
            frame=memory.frame,
            task=self._task.name,
            objects=tuple(entry.name for entry in self._task.objects),
            K=known.matrix,
            T_odom_optical=T_odom_optical,
            hands=palms,
            color=color,
            depth=depth,
            masks=found,
            dt_s=eyes.dt_s,
            region=self._task.form,
        )


def _older(sighting: Sighting | None, dt_s: float) -> Sighting | None:
    """Return what is known of an object some time [s] later."""
    if sighting is None:
        return None
    return Sighting(T_odom_object=sighting.T_odom_object, valid=False, age_s=sighting.age_s + dt_s)
