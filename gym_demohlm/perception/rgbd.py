"""Drawn depth with a D435's errors, and masks -> tracked objects: what a robot with this software would know.

Furniture stays where it stands. Once it is known where, it is looked at twice a second only, and counts as seen in
between.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import camera, d435, masks
from gym_demohlm.perception.glass import Glass
from gym_demohlm.perception.meshes import ObjectMesh, known_meshes
from gym_demohlm.perception.object_trackers import ObjectTrackers, doors
from gym_demohlm.perception.picture import photographed
from gym_demohlm.perception.seeing import Eyes, Mounting, SeeingPerceiver, Sighting
from gym_demohlm.perception.settings import FOCAL_OF_DEGREE, SHIFT_OF_DEGREE, PerceptionSettings
from gym_demohlm.perception.tracker import Tracker
from gym_demohlm.perception.visual_model import Frame, VisualModel
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task

_MARGIN = 60.0  # px around an object in which it is looked for
_FOLLOWED_S = 0.35  # an object lost for longer is looked for in the whole image
_FIXED_S = 0.5  # from one look at furniture to the next
_LEAST_PATCH = 40  # px, fewer of an object's colour are something else


@dataclass(frozen=True, kw_only=True)
class RgbdSettings:
    """What is wrong with the eyes.

    Attributes:
        noise: How the depth camera errs.
        masks: "oracle" for the renderer's ids with rough edges, "color" for the picture's colours.
        mask_jitter: Standard deviation of the place of an oracle mask's edge [px].
        mounting: What the robot knows wrongly of its camera and of its motion.
        focal_factor: Known focal length over the true one.
        mesh_scale: Size of the known meshes over that of the objects.
    """

    noise: d435.DepthNoise = field(default_factory=d435.DepthNoise)
    masks: str = "oracle"
    mask_jitter: float = 1.0
    mounting: Mounting = field(default_factory=Mounting)
    focal_factor: float = 1.0
    mesh_scale: float = 1.0

    @classmethod
    def of(cls, settings: PerceptionSettings) -> "RgbdSettings":
        """Return what the options of ``gym.make`` and ``demohlm evaluate`` stand for."""
        return cls(
            masks=settings.masks,
            mounting=mounting_of(settings),
            focal_factor=1.0 + FOCAL_OF_DEGREE * settings.camera_error,
            mesh_scale=settings.mesh_scale,
        )


def mounting_of(settings: PerceptionSettings) -> Mounting:
    """Return how far off a camera is mounted."""
    return Mounting(
        camera_turn=math.radians(settings.camera_error), camera_shift=SHIFT_OF_DEGREE * settings.camera_error
    )


@dataclass
class _Memory:
    """What is remembered of one world.

    Attributes:
        scale: The depth camera's factor.
        followed: The objects; None before the first look.
        since_s: Since furniture was looked at [s].
    """

    scale: float
    followed: ObjectTrackers | None = None
    since_s: float = math.inf


class RgbdPerceiver(SeeingPerceiver):
    """Tracks the objects in rendered depth.

    Args:
        task: The task.
        num_worlds: N of the simulation.
        settings: What is wrong with the eyes.

    Raises:
        SceneError: This machine has nothing to draw with, or masks are by colour and an object is grey; at the first
            look.
    """

    def __init__(self, task: Task, num_worlds: int, settings: RgbdSettings | None = None) -> None:
        self._settings = settings or RgbdSettings()
        super().__init__(task, num_worlds, self._settings.mounting)
        self._meshes: tuple[ObjectMesh, ...] = ()
        self._doors: dict[int, tuple[int, np.ndarray]] = {}

    def _begin_world(self, eyes: Eyes, row: int) -> None:
        eyes.memory = _Memory(scale=d435.episode_scale(self._settings.noise, eyes.rng))

    def _open(self, sim: Simulation) -> VisualModel:
        visual, model = VisualModel(sim.model), sim.model
        self._meshes = known_meshes(sim.scene)
        if self._settings.masks == "color":
            masks.refuse_grey(self._meshes)
        self._doors = doors(model, self._meshes)
        self._glass = Glass(visual)
        pelvis = model.body("pelvis").id
        self._robot = np.append(model.body_rootid[model.geom_bodyid] == pelvis, False)  # the last: id -1
        return visual

    def _look(
        self, visual: VisualModel, eyes: Eyes, T_odom_optical: np.ndarray, palms: dict[str, np.ndarray]
    ) -> list[Sighting | None]:
        settings, memory = self._settings, eyes.memory
        assert isinstance(memory, _Memory)
        if memory.followed is None:
            known = visual.intrinsics.scaled(settings.focal_factor)
            meshes = [mesh.scaled(settings.mesh_scale) for mesh in self._meshes]
            memory.followed = ObjectTrackers(meshes, known, self._doors)
        trackers = memory.followed.trackers
        due = self._due(memory, trackers, eyes.dt_s)
        for k in set(range(len(trackers))) - set(due):
            trackers[k].skip(eyes.dt_s)
        if not due:
            return [sighting_of(tracker) for tracker in trackers]
        window = self._window([trackers[k] for k in due], T_odom_optical, visual)
        frame, depth = self._measured(visual, eyes, memory.scale, window)
        found = self._masks(visual, eyes, frame, {k: trackers[k] for k in due}, T_odom_optical)
        memory.followed.update(
            depth,
            found,
            frame.window,
            T_odom_optical,
            eyes.dt_s,
            hands_before=eyes.palms,
            hands=palms,
            robot=self._robot[frame.ids],
        )
        return [sighting_of(tracker) for tracker in trackers]

    def _due(self, memory: _Memory, trackers: Sequence[Tracker], dt_s: float) -> list[int]:
        """Return the objects to be looked at in this frame."""
        memory.since_s += dt_s
        everything = memory.since_s > _FIXED_S - 0.5 * dt_s
        if everything:
            memory.since_s = 0.0
        numbers = range(len(trackers))
        return [k for k in numbers if everything or not (self._meshes[k].fixed and _can_wait(trackers[k]))]

    def _masks(
        self, visual: VisualModel, eyes: Eyes, frame: Frame, trackers: dict[int, Tracker], T_odom_optical: np.ndarray
    ) -> dict[int, np.ndarray]:
        """Return the pixels (height, width) bool, in a window, of each object that is looked at."""
        if self._settings.masks == "oracle":
            jitter = self._settings.mask_jitter
            return {k: masks.oracle(frame.ids, self._meshes[k].geoms, eyes.rng, jitter) for k in trackers}
        picture = photographed(visual.rgb(frame.window), eyes.rng)
        found = {}
        for k, tracker in trackers.items():
            T, expected = tracker.expected(T_odom_optical), None
            if T is not None and T[2, 3] > 0:
                middle = visual.intrinsics.project(poses.transform(T, tracker.shape.middle[None]))[0]
                expected = tuple((middle - frame.window.corner).tolist())
            colored = masks.color(picture, self._meshes[k].colors)
            found[k] = masks.component_near(colored, expected, _LEAST_PATCH)
        return found

    def _measured(
        self, visual: VisualModel, eyes: Eyes, scale: float, window: camera.Window
    ) -> tuple[Frame, np.ndarray]:
        """Return ids and true depth of a window, and the measured depth."""
        frame = visual.depth_and_ids(window)
        noise, focal, behind = self._settings.noise, visual.intrinsics.focal, self._glass.behind(frame)
        measured = d435.measure(frame.depth, noise, eyes.rng, scale=scale, image_focal=focal, behind=behind)
        return frame, measured

    def _window(self, trackers: list[Tracker], T_odom_optical: np.ndarray, visual: VisualModel) -> camera.Window:
        """Return the part of the image in which the objects should be; all of it where one is lost."""
        intrinsics = visual.intrinsics
        everything = camera.whole(intrinsics)
        low, high = [], []
        for tracker in trackers:
            T = tracker.expected(T_odom_optical)
            if T is None or tracker.track is None or tracker.track.age_s > _FOLLOWED_S:
                return everything
            p_optical = poses.transform(T, tracker.shape.vertices)
            window = None
            if p_optical[:, 2].min() > 0.1:
                window = camera.window_around(intrinsics.project(p_optical), _MARGIN, intrinsics)
            if window is None:
                return everything
            low.append(window.corner)
            high.append(window.corner + np.array([window.width, window.height]))
        left, top = np.min(low, axis=0).astype(int).tolist()
        right, bottom = np.max(high, axis=0).astype(int).tolist()
        return camera.Window(left=left, top=top, width=right - left, height=bottom - top)


def _can_wait(tracker: Tracker) -> bool:
    """Return whether furniture need not be looked at in each frame: its place is known, or it was lost."""
    return tracker.track is not None and (tracker.is_settled or not tracker.track.valid)


def sighting_of(tracker: Tracker) -> Sighting | None:
    """Return what a tracker knows after a frame."""
    track = tracker.track
    if track is None:
        return None
    return Sighting(T_odom_object=track.T_odom_object, valid=track.valid, age_s=track.age_s, inliers=track.inliers)
