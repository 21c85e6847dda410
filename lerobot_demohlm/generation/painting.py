"""The states of attempts as they were simulated -> pictures of the successful ones, drawn after the fact.

Nothing that is drawn has a way back into the simulation, so a dataset with pictures has the states, bit for bit, of
the one without.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import mujoco
import numpy as np
from lerobot.datasets.compute_stats import get_feature_stats

from gym_demohlm import poses
from gym_demohlm.errors import DatasetError
from gym_demohlm.perception.camera import Intrinsics, head_intrinsics
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.variation import NONE, Conditions, Variation
from lerobot_demohlm.datasets import videos
from lerobot_demohlm.datasets.cameras import CameraSpec, PictureFacts
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.pictures import DrawnBlock, DrawnEpisode, features_of
from lerobot_demohlm.generation.appearance import Appearance

APPEARANCE_STREAM = 8  # first number of a seed sequence, so that its draws are no other stream's
ROUNDING = 1e-6  # of joint positions to float32 [rad]


class StateRecorder:
    """Keeps what pictures need of the worlds of a simulation, at the start and after every step."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget the attempts that are over."""
        self._qpos: list[np.ndarray] = []
        self._mocap: list[np.ndarray] = []
        self._memory: list[np.ndarray] = []
        self._conditions: list[Conditions] = []

    def __call__(self, sim: Simulation) -> None:
        """Keep the present state of all worlds."""
        snapshot = sim.snapshot()
        self._qpos.append(sim.qpos)
        self._mocap.append(snapshot["mocap"])
        self._memory.append(snapshot.get("memory", np.zeros((sim.num_worlds, 0))))
        self._conditions = [sim.conditions(world) for world in range(sim.num_worlds)]

    def state(self, step: int, world: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return qpos (nq,), mocap (7 nmocap,) and memory of a world before an action."""
        return self._qpos[step][world], self._mocap[step][world], self._memory[step][world]

    def conditions(self, world: int) -> Conditions:
        """Return how a world differs from the plain one."""
        return self._conditions[world]


class Painter:
    """Draws states of one task with some cameras.

    Args:
        task: The task.
        facts: Which cameras, and how pictures vary.
        variation: What differs from world to world; an episode says how.

    Raises:
        SceneError: This machine has nothing to draw with.
    """

    def __init__(self, task: Task, facts: PictureFacts, variation: Variation = NONE) -> None:
        self._task, self._facts = task, facts
        self._scene = build_scene(task, variation=variation)
        self._visuals = [
            VisualModel(self._scene.model, _intrinsics(self._scene.model, camera), camera=camera.name)
            for camera in facts.cameras
        ]
        self.features = features_of(
            facts.cameras,
            {
                camera.name: {
                    "fx": visual.intrinsics.focal,
                    "fy": visual.intrinsics.focal,
                    "cx": visual.intrinsics.center_u,
                    "cy": visual.intrinsics.center_v,
                }
                for camera, visual in zip(facts.cameras, self._visuals, strict=True)
            },
        )

    def paint(self, episodes: Sequence[Episode], recorder: StateRecorder, folder: Path) -> DrawnBlock:
        """Draw the successful episodes of a block.

        Args:
            episodes: One a world, in the order of the worlds.
            recorder: Their states.
            folder: Where the videos are written.

        Raises:
            DatasetError: The states are not those of the episodes.
        """
        drawn: list[DrawnEpisode] = []
        with ExitStack() as open_files:
            writers: dict[str, videos.VideoWriter] = {}
            for camera in self._facts.cameras:
                for stream in camera.streams:
                    path = folder / f"{camera.key(stream)}.mp4"
                    writer = videos.VideoWriter(path, camera.width, camera.height, stream == "depth")
                    writers[camera.key(stream)] = open_files.enter_context(writer)
            for world, episode in enumerate(episodes):
                if episode.outcome == "success":
                    drawn.append(self._paint(episode, world, recorder, writers))
        return DrawnBlock(features=self.features, episodes=drawn, files={key: folder / f"{key}.mp4" for key in writers})

    def frame(
        self, visual: VisualModel, camera: CameraSpec, state: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the picture of each stream by its feature, and the camera's pose (7,)."""
        qpos, mocap, memory = state
        count = len(mocap) // 7
        visual.place(qpos, mocap[: 3 * count].reshape(-1, 3), mocap[3 * count :].reshape(-1, 4))
        if self._task.memory is not None:
            self._task.memory.draw(visual.model, memory)
        rgb, depth = (camera.key(stream) for stream in ("rgb", "depth"))
        if set(camera.streams) == {"rgb", "depth"}:
            pictures = dict(zip((rgb, depth), visual.rgb_and_depth(), strict=True))
        elif "rgb" in camera.streams:
            pictures = {rgb: visual.rgb()}
        else:
            pictures = {depth: visual.depth_and_ids().depth}
        return pictures, np.concatenate(poses.split(visual.camera_pose())).astype(np.float32)

    def frames(
        self,
        episode_seed: tuple[int, int],
        states: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
        conditions: Conditions | None = None,
    ) -> dict[str, np.ndarray]:
        """Return all pictures of some states and the cameras' poses by feature, to be compared with stored ones.

        Args:
            episode_seed: Seed of the run and index of the attempt, which its appearance is a function of.
            states: qpos, mocap and memory of each.
            conditions: How their world differs from the plain one; not at all by default.
        """
        shapes = self._scene.shapes(conditions or Conditions())
        found: dict[str, list[np.ndarray]] = {}
        for camera, visual in zip(self._facts.cameras, self._visuals, strict=True):
            visual.wear(shapes)
            with self._appearance(visual, episode_seed):
                for state in states:
                    pictures, pose = self.frame(visual, camera, state)
                    for key, picture in pictures.items():
                        found.setdefault(key, []).append(picture)
                    found.setdefault(camera.pose_key, []).append(pose)
        return {key: np.stack(values) for key, values in found.items()}

    def close(self) -> None:
        """Give the graphics contexts back."""
        for visual in self._visuals:
            visual.close()

    def _paint(
        self, episode: Episode, world: int, recorder: StateRecorder, writers: dict[str, videos.VideoWriter]
    ) -> DrawnEpisode:
        length = len(episode.success)
        states = [recorder.state(step, world) for step in range(length)]
        conditions = recorder.conditions(world)
        self._require_same(episode, states[0][0], conditions)
        start = next(iter(writers.values())).num_frames
        columns, stats = {}, {}
        for key, frames in self.frames((episode.seed, episode.index), states, conditions).items():
            if key not in writers:
                columns[key] = frames
                continue
            for step, frame in enumerate(frames):
                writers[key].add(frame, key=step == 0)
            depth = frames.ndim == 3
            shown = np.clip(frames, videos.DEPTH_MIN, videos.DEPTH_MAX) if depth else frames
            found = get_feature_stats(videos.sampled(shown), axis=(0, 2, 3), keepdims=True)
            scale = 1.0 if depth else 255.0
            stats[key] = {k: v if k == "count" else np.squeeze(v / scale, axis=0) for k, v in found.items()}
        return DrawnEpisode(columns=columns, stats=stats, start=start)

    def _require_same(self, episode: Episode, qpos: np.ndarray, conditions: Conditions) -> None:
        """Raise ``DatasetError`` where a state is not the one that an episode began with.

        An episode has the joints as its world's encoders read them: off by a bias and a noise, at most, if it varies.
        """
        seen = qpos[self._scene.body_qpos].astype(np.float32)
        limit = sum(conditions.number(f"robot.{name}", plain=0.0) for name in ("encoder_bias", "encoder"))
        off = np.abs(seen - episode.state[0, : len(seen)]).max()
        if off > (limit + ROUNDING if limit else 0.0):
            raise DatasetError("states of another attempt", "those of the episode", "report it")

    def _appearance(self, visual: VisualModel, episode_seed: tuple[int, int]) -> Appearance:
        rng = np.random.default_rng([APPEARANCE_STREAM, *episode_seed])
        return Appearance(visual, self._task, self._facts, rng)


def _intrinsics(model: mujoco.MjModel, camera: CameraSpec) -> Intrinsics:
    """Return a camera's intrinsics for images of a size; the vertical field of view stays what it is."""
    if camera.name == "head":
        return head_intrinsics(camera.width, camera.height)
    fovy = np.radians(float(model.camera(camera.name).fovy[0]))
    return Intrinsics(
        width=camera.width,
        height=camera.height,
        focal=camera.height / (2.0 * np.tan(fovy / 2.0)),
        center_u=(camera.width - 1) / 2.0,
        center_v=(camera.height - 1) / 2.0,
    )
