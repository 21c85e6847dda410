"""Worlds -> what their head cameras look at, one after the other: what every perceiver that draws pictures does alike.

It places the drawn copy of the scene, lets odometry and the camera's mounting err, and holds the pose of what is not
seen in odometry coordinates.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import camera
from gym_demohlm.perception.equivalents import steady_equivalent
from gym_demohlm.perception.estimate import PERCEPTION_STREAM, UNSEEN, PoseEstimate
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """What the robot knows wrongly of its camera and of its own motion.

    Attributes:
        odometry_drift: Share of the camera's way and turn by which odometry errs in each step.
        camera_turn: Angle by which the camera is mounted otherwise than the robot knows [rad].
        camera_shift: Distance by which it is [m].
    """

    odometry_drift: float = 0.01
    camera_turn: float = 0.0
    camera_shift: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """What is known of one object after a frame.

    Attributes:
        T_odom_object: (4, 4).
        valid: Whether this frame showed it.
        age_s: Time since a frame did [s].
        inliers: See ``PoseEstimate``.
    """

    T_odom_object: np.ndarray
    valid: bool
    age_s: float
    inliers: float = 1.0


@dataclass
class Eyes:
    """What is remembered of one world.

    Attributes:
        rng: Of all that is random in what it sees.
        T_mounted_known: (4, 4) where the robot takes its camera to be, seen from where it is.
        T_odom_world: (4, 4) the world in odometry coordinates.
        T_world_optical: (4, 4) the camera's last pose; None at first.
        time_s: Of the world at the last look [s]; None at first.
        dt_s: From the last look to this one [s].
        palms: The palms' last poses (4, 4) in odometry coordinates, by side.
        shown: The pose (4, 4) of each object that was told last, in odometry coordinates.
        memory: What else a source remembers of this world.
    """

    rng: np.random.Generator
    T_mounted_known: np.ndarray
    T_odom_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_world_optical: np.ndarray | None = None
    time_s: float | None = None
    dt_s: float = STEP_DT
    palms: dict[str, np.ndarray] = field(default_factory=dict)
    shown: list[np.ndarray | None] = field(default_factory=list)
    memory: object = None


class SeeingPerceiver(ABC):
    """Looks at worlds one after the other through a drawn picture.

    Args:
        task: The task.
        num_worlds: N of the simulation.
        mounting: What the robot knows wrongly.

    Raises:
        SceneError: This machine has nothing to draw with; at the first look.
    """

    def __init__(self, task: Task, num_worlds: int, mounting: Mounting) -> None:
        self._task, self._mounting = task, mounting
        self._visual: VisualModel | None = None
        self._eyes: list[Eyes | None] = [None] * num_worlds

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Forget everything about some worlds; draw what is wrong with their cameras."""
        for row, seed in zip(rows, seeds, strict=True):
            rng = np.random.default_rng([PERCEPTION_STREAM, seed])
            axes = rng.standard_normal((2, 3))
            axes /= np.linalg.norm(axes, axis=1, keepdims=True)
            turn, shift = self._mounting.camera_turn * axes[0], self._mounting.camera_shift * axes[1]
            self._eyes[row] = eyes = Eyes(
                rng=rng, T_mounted_known=poses.from_rotation(poses.rotation_from_vector(turn), shift)
            )
            self._begin_world(eyes, int(row))

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Look at some worlds (n,); a world that has not begun begins with its number as seed."""
        visual = self._opened(sim)
        qpos, times = sim.qpos, sim.time
        bodies = np.argsort(sim.model.body_mocapid, kind="stable")[sim.model.nbody - sim.model.nmocap :]
        mocap = [sim.pose(sim.model.body(body).name) for body in bodies]
        palms = {side: sim.pose(f"{side}_palm") for side in g1.SIDES}
        told, sightings = [], []
        for row in rows:
            if self._eyes[row] is None:
                self.begin(np.array([row]), [int(row)])
            eyes = self._eyes[row]
            assert eyes is not None
            self._wear(visual, sim, int(row))
            placed = [poses.split(T[row]) for T in mocap]
            positions = np.array([position for position, _ in placed]).reshape(-1, 3)
            visual.place(qpos[row], positions, np.array([quat for _, quat in placed]).reshape(-1, 4))
            T_odom_optical = self._moved(eyes, visual.camera_pose())
            now = {side: eyes.T_odom_world @ palms[side][row] for side in palms}
            if eyes.time_s is not None:
                eyes.dt_s = round(max(float(times[row]) - eyes.time_s, 0.0), 4)
            eyes.time_s = float(times[row])
            seen = self._look(visual, eyes, T_odom_optical, now)
            eyes.palms = now
            sightings.append(seen)
            told.append(self._told(eyes, T_odom_optical, seen))
        return PoseEstimate(
            T_camera_object=np.array(told),
            valid=np.array([[entry is not None and entry.valid for entry in seen] for seen in sightings]),
            age_s=np.array([[math.inf if entry is None else entry.age_s for entry in seen] for seen in sightings]),
            inliers=np.array([[0.0 if entry is None else entry.inliers for entry in seen] for seen in sightings]),
        )

    def close(self) -> None:
        """Give the graphics context back."""
        if self._visual is not None:
            self._visual.close()
            self._visual = None

    @abstractmethod
    def _begin_world(self, eyes: Eyes, row: int) -> None:
        """Forget what the source remembers of a world."""

    @abstractmethod
    def _open(self, sim: Simulation) -> VisualModel:
        """Return the model to draw."""

    @abstractmethod
    def _look(
        self, visual: VisualModel, eyes: Eyes, T_odom_optical: np.ndarray, palms: dict[str, np.ndarray]
    ) -> Sequence[Sighting | None]:
        """Return what is known of each object of one world; None of one that was never seen.

        Args:
            visual: Placed as the world is.
            eyes: What is remembered of the world.
            T_odom_optical: (4, 4) where odometry has the camera.
            palms: Where it has the palms (4, 4), by side.
        """

    def _opened(self, sim: Simulation) -> VisualModel:
        if self._visual is None:
            self._visual = self._open(sim)
        return self._visual

    def _wear(self, visual: VisualModel, sim: Simulation, row: int) -> None:
        """Have the drawn scene the sizes of a world's own; what the robot knows of objects stays as it is."""
        if sim.variation:
            visual.wear(sim.scene.shapes(sim.conditions(row)))

    def _moved(self, eyes: Eyes, T_world_optical: np.ndarray) -> np.ndarray:
        """Let odometry err by a share of the camera's motion; always the same number of draws."""
        draws = eyes.rng.standard_normal(6)
        if eyes.T_world_optical is not None:
            motion = poses.invert(eyes.T_world_optical) @ T_world_optical
            way = float(np.linalg.norm(motion[:3, 3]))
            turn = float(np.linalg.norm(poses.rotation_vector(motion[:3, :3])))
            share = self._mounting.odometry_drift
            about = eyes.T_odom_world @ T_world_optical
            error = poses.from_rotation(poses.rotation_from_vector(share * turn * draws[3:]), share * way * draws[:3])
            eyes.T_odom_world = about @ error @ poses.invert(T_world_optical)
        eyes.T_world_optical = T_world_optical
        return eyes.T_odom_world @ T_world_optical

    def _told(self, eyes: Eyes, T_odom_optical: np.ndarray, seen: Sequence[Sighting | None]) -> np.ndarray:
        """Return the poses (k, 4, 4) in the frame ``head_camera``, of equivalent ones always the same."""
        T_odom_camera = T_odom_optical @ camera.T_OPTICAL_CAMERA
        T_camera_odom = poses.invert(T_odom_camera)
        eyes.shown = eyes.shown or [None] * len(seen)
        told = []
        for k, entry in enumerate(seen):
            if entry is None:
                told.append(poses.pose(UNSEEN))
                continue
            shown = steady_equivalent(entry.T_odom_object, self._task.objects[k], T_odom_camera, eyes.shown[k])
            eyes.shown[k] = shown
            told.append(eyes.T_mounted_known @ T_camera_odom @ shown)
        return np.stack(told)
