"""Worlds -> where each tracked object seems to be, in the camera's frame: one way to see, with several sources.

``exact`` asks the simulator. ``rgbd`` draws what a D435 on the head would measure and tracks the objects in it. Both
answer with a ``PoseEstimate``, from which an observation and the gaze are made.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.perception import camera, d435, masks
from gym_demohlm.perception.equivalents import nearest_equivalent, steady_equivalent
from gym_demohlm.perception.meshes import TRANSPARENT, ObjectMesh, object_meshes
from gym_demohlm.perception.tracker import Tracker
from gym_demohlm.perception.visual_model import Frame, VisualModel
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import ObjectSpec, Task
from gym_demohlm.timing import STEP_DT

PERCEPTION_STREAM = 7  # first number of a seed sequence, so that its draws are no other stream's
SOURCES = ("exact", "rgbd")
_NEAR_HAND = 0.22  # m, palm to a corner of an object that it may move
_MARGIN = 60.0  # px around an object in which it is looked for
_FOLLOWED_S = 0.35  # an object lost for longer is looked for in the whole image
_UNSEEN = np.array([1.0, 0.0, 0.0])  # m, where an object is said to be before it was seen


@dataclass(frozen=True, kw_only=True)
class PoseEstimate:
    """Where objects seem to be; rows are worlds, columns the task's objects in their order.

    Attributes:
        T_camera_object: (n, k, 4, 4) poses in the frame ``head_camera``, of equivalent ones the nearest to the
            camera's heading.
        valid: (n, k) whether the newest frame showed the object; where it did not, the last pose is held in odometry
            coordinates.
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


def make_perceiver(source: str, task: Task, num_worlds: int) -> Perceiver:
    """Return a perceiver by its name.

    Args:
        source: One of ``SOURCES``.
        task: The task.
        num_worlds: N of the simulation.

    Raises:
        UnknownNameError: There is no such source.
        SceneError: The source needs graphics, and this machine has none.
    """
    if source not in SOURCES:
        raise UnknownNameError("perception", source, SOURCES)
    return ExactPerceiver() if source == "exact" else RgbdPerceiver(task, num_worlds)


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


@dataclass(frozen=True, kw_only=True)
class RgbdSettings:
    """What is wrong with the eyes.

    Attributes:
        noise: How the depth camera errs.
        mask_jitter: Standard deviation of the place of a mask's edge [px].
        odometry_drift: Share of the camera's way and turn by which odometry errs in each step.
        camera_turn: Angle by which the camera is mounted otherwise than the robot knows [rad].
        camera_shift: Distance by which it is [m].
        focal_factor: Known focal length over the true one.
        mesh_scale: Size of the known meshes over that of the objects.
    """

    noise: d435.DepthNoise = field(default_factory=d435.DepthNoise)
    mask_jitter: float = 1.0
    odometry_drift: float = 0.01
    camera_turn: float = 0.0
    camera_shift: float = 0.0
    focal_factor: float = 1.0
    mesh_scale: float = 1.0


@dataclass
class _Eyes:
    """What is remembered of one world."""

    rng: np.random.Generator
    scale: float
    T_mounted_known: np.ndarray
    trackers: list[Tracker]
    T_odom_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_world_optical: np.ndarray | None = None
    palms: dict[str, np.ndarray] = field(default_factory=dict)
    shown: list[np.ndarray | None] = field(default_factory=list)


class RgbdPerceiver:
    """Tracks the objects in rendered depth, with masks from the renderer's ids whose edges are rough (``oracle``).

    Args:
        task: The task.
        num_worlds: N of the simulation.
        settings: What is wrong with the eyes.

    Raises:
        SceneError: This machine has nothing to draw with.
    """

    def __init__(self, task: Task, num_worlds: int, settings: RgbdSettings | None = None) -> None:
        self._task, self._settings = task, settings or RgbdSettings()
        self._visual: VisualModel | None = None
        self._eyes: list[_Eyes | None] = [None] * num_worlds
        self._meshes: tuple[ObjectMesh, ...] = ()

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Forget everything about some worlds; draw what is wrong with their cameras."""
        for row, seed in zip(rows, seeds, strict=True):
            rng = np.random.default_rng([PERCEPTION_STREAM, seed])
            axes = rng.standard_normal((2, 3))
            axes /= np.linalg.norm(axes, axis=1, keepdims=True)
            settings = self._settings
            self._eyes[row] = _Eyes(
                rng=rng,
                scale=d435.episode_scale(settings.noise, rng),
                T_mounted_known=poses.from_rotation(
                    poses.rotation_from_vector(settings.camera_turn * axes[0]), settings.camera_shift * axes[1]
                ),
                trackers=[],
            )

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Draw, measure and track in some worlds (n,); a world that has not begun begins with its number as seed."""
        visual = self._opened(sim)
        qpos = sim.qpos
        bodies = np.argsort(sim.model.body_mocapid, kind="stable")[sim.model.nbody - sim.model.nmocap :]
        mocap = [sim.pose(sim.model.body(body).name) for body in bodies]
        palms = {side: sim.pose(f"{side}_palm") for side in g1.SIDES}
        estimates = []
        for row in rows:
            if self._eyes[row] is None:
                self.begin(np.array([row]), [int(row)])
            eyes = self._eyes[row]
            assert eyes is not None
            placed = [poses.split(T[row]) for T in mocap]
            positions = np.array([position for position, _ in placed]).reshape(-1, 3)
            visual.place(qpos[row], positions, np.array([quat for _, quat in placed]).reshape(-1, 4))
            estimates.append(self._look(visual, eyes, {side: palms[side][row] for side in palms}))
        return PoseEstimate(
            T_camera_object=np.stack([entry[0] for entry in estimates]),
            valid=np.stack([entry[1] for entry in estimates]),
            age_s=np.stack([entry[2] for entry in estimates]),
            inliers=np.stack([entry[3] for entry in estimates]),
        )

    def close(self) -> None:
        """Give the graphics context back."""
        if self._visual is not None:
            self._visual.close()
            self._visual = None

    def _opened(self, sim: Simulation) -> VisualModel:
        """Return the model to draw, made at the first look."""
        if self._visual is None:
            self._visual = VisualModel(sim.model)
            self._meshes = object_meshes(sim.model, self._task)
            model = sim.model
            seen = (model.geom_rgba[:, 3] > 0) & (model.geom_rgba[:, 3] < TRANSPARENT)
            self._transparent = np.flatnonzero(seen)
            pelvis = model.body("pelvis").id
            self._robot = np.append(model.body_rootid[model.geom_bodyid] == pelvis, False)  # the last: id -1
        return self._visual

    def _look(
        self, visual: VisualModel, eyes: _Eyes, palms: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return pose (k, 4, 4), valid (k,), age (k,) and inliers (k,) of the objects of one world."""
        settings = self._settings
        if not eyes.trackers:
            known = visual.intrinsics.scaled(settings.focal_factor)
            eyes.trackers = [Tracker(mesh.scaled(settings.mesh_scale), known) for mesh in self._meshes]
            eyes.shown = [None] * len(eyes.trackers)
        T_world_optical = visual.camera_pose()
        self._drift(eyes, T_world_optical)
        T_odom_optical = eyes.T_odom_world @ T_world_optical
        palms = {side: eyes.T_odom_world @ T for side, T in palms.items()}
        frame, depth = self._measured(visual, eyes, self._window(eyes, T_odom_optical, visual.intrinsics))
        found = [masks.oracle(frame.ids, mesh.geoms, eyes.rng, settings.mask_jitter) for mesh in self._meshes]
        hiders = self._robot[frame.ids]
        in_front = []
        for mask in found:  # what comes first in a task is handled on, in or before what follows
            in_front.append(hiders)
            hiders = hiders | mask
        order = sorted(range(len(found)), key=lambda k: self._task.objects[k].moves_with is not None)
        for k in order:
            tracker, entry = eyes.trackers[k], self._task.objects[k]
            tracker.update(
                depth,
                found[k],
                frame.window,
                T_odom_optical,
                STEP_DT,
                self._hand_motions(tracker, eyes.palms, palms),
                in_front[k],
                self._lies(entry, eyes, T_odom_optical),
            )
        eyes.palms = palms
        return self._told(eyes, T_odom_optical)

    def _measured(self, visual: VisualModel, eyes: _Eyes, window: camera.Window) -> tuple[Frame, np.ndarray]:
        """Return ids and true depth of a window, and the measured depth."""
        frame = visual.depth_and_ids(window)
        behind = None
        if len(self._transparent):
            behind = visual.depth_and_ids(window, self._transparent).depth
        noise = self._settings.noise
        measured = d435.measure(
            frame.depth, noise, eyes.rng, scale=eyes.scale, image_focal=visual.intrinsics.focal, behind=behind
        )
        return frame, measured

    def _told(self, eyes: _Eyes, T_odom_optical: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        T_odom_camera = T_odom_optical @ camera.T_OPTICAL_CAMERA
        T_camera_odom = poses.invert(T_odom_camera)
        told, valid, age, inliers = [], [], [], []
        for k, tracker in enumerate(eyes.trackers):
            track = tracker.track
            if track is None:
                T = poses.pose(_UNSEEN)
            else:
                shown = steady_equivalent(track.T_odom_object, self._task.objects[k], T_odom_camera, eyes.shown[k])
                eyes.shown[k] = shown
                T = eyes.T_mounted_known @ T_camera_odom @ shown
            told.append(T)
            valid.append(track is not None and track.valid)
            age.append(math.inf if track is None else track.age_s)
            inliers.append(0.0 if track is None else track.inliers)
        return np.stack(told), np.array(valid), np.array(age), np.array(inliers)

    def _drift(self, eyes: _Eyes, T_world_optical: np.ndarray) -> None:
        """Let odometry err by a share of the camera's motion; always the same number of draws."""
        draws = eyes.rng.standard_normal(6)
        if eyes.T_world_optical is not None:
            motion = poses.invert(eyes.T_world_optical) @ T_world_optical
            way = float(np.linalg.norm(motion[:3, 3]))
            turn = float(np.linalg.norm(poses.rotation_vector(motion[:3, :3])))
            share = self._settings.odometry_drift
            about = eyes.T_odom_world @ T_world_optical
            error = poses.from_rotation(poses.rotation_from_vector(share * turn * draws[3:]), share * way * draws[:3])
            eyes.T_odom_world = about @ error @ poses.invert(T_world_optical)
        eyes.T_world_optical = T_world_optical

    def _window(self, eyes: _Eyes, T_odom_optical: np.ndarray, intrinsics: camera.Intrinsics) -> camera.Window:
        """Return the part of the image in which the objects should be; all of it where one is lost."""
        everything = camera.whole(intrinsics)
        low, high = [], []
        for tracker in eyes.trackers:
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

    def _hand_motions(
        self, tracker: Tracker, before: dict[str, np.ndarray], now: dict[str, np.ndarray]
    ) -> list[np.ndarray]:
        """Return the motions since the last frame of the palms near an object."""
        if tracker.track is None or not before:
            return []
        corners = poses.transform(tracker.track.T_odom_object, tracker.shape.vertices)
        near = [side for side in now if np.linalg.norm(corners - before[side][:3, 3], axis=1).min() < _NEAR_HAND]
        return [now[side] @ poses.invert(before[side]) for side in near]

    def _lies(self, entry: ObjectSpec, eyes: _Eyes, T_odom_optical: np.ndarray) -> np.ndarray | None:
        """Return roughly how an object lies at first: as what carries it, or facing the robot; None for any yaw."""
        if entry.moves_with is not None:
            names = [other.name for other in self._task.objects]
            carrier = eyes.trackers[names.index(entry.moves_with)].track
            if carrier is not None:
                turn = entry.yaw - self._task.object(entry.moves_with).yaw
                return carrier.T_odom_object[:3, :3] @ poses.planar(0.0, 0.0, turn)[:3, :3]
        if entry.symmetry != (0.0,):
            return None
        heading = math.atan2(T_odom_optical[1, 2], T_odom_optical[0, 2])
        return poses.planar(0.0, 0.0, heading + entry.yaw)[:3, :3]
