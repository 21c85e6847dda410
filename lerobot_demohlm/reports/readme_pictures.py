"""A generated episode of each task, and a rollout of a policy -> the pictures of the README.

One small picture per task shows its decisive moment. One film shows an episode of LiftBox as it was generated and, next
to it, a policy that learned the task. Draw them again with

    python -m lerobot_demohlm.reports.readme_pictures --policy PRETRAINED_MODEL

where the policy may be that of the quickstart, ``outputs/quickstart/train/checkpoints/last/pretrained_model``.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro
from PIL import Image

from gym_demohlm import poses
from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.registry import get_task
from lerobot_demohlm.reports.films import SHADOW_SIZE, Take, generated_take, policy_take

REGION, SEED, INDEX = "R3", 0, 0  # of the generated episodes
FILM_TASK = "LiftBox"
FILM_NAME = "film.webp"
FILM_STRIDE = 2  # every second step is shown
FILM_FRAME_MS = 100  # so the film runs at twice the speed of the robot
FILM_LAST_MS = 1500  # the last frame stays for this long


@dataclass(frozen=True, kw_only=True)
class View:
    """Where the camera stands, seen from the robot.

    Attributes:
        azimuth_deg: Direction in which the camera looks, relative to the robot's heading [degrees]: 0 looks over its
            shoulder, 180 at its face; positive values turn the camera counter-clockwise, seen from above.
        elevation_deg: Angle above the horizon in which it looks [degrees]; negative values look down.
        distance: From the point that it looks at [m].
        height: Of that point above the floor [m].
        towards: Where that point is between the pelvis (0) and the task's first object (1).
    """

    azimuth_deg: float = 130.0
    elevation_deg: float = -14.0
    distance: float = 1.5
    height: float = 0.8
    towards: float = 0.4

    def camera(self, T_world_pelvis: np.ndarray, p_world_object: np.ndarray) -> mujoco.MjvCamera:
        """Return the camera.

        Args:
            T_world_pelvis: (4, 4) pose of the robot's pelvis.
            p_world_object: (3,) position of the task's first object [m].
        """
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:2] = (1.0 - self.towards) * T_world_pelvis[:2, 3] + self.towards * p_world_object[:2]
        camera.lookat[2] = self.height
        camera.azimuth = float(np.degrees(poses.yaw(T_world_pelvis))) + self.azimuth_deg
        camera.elevation, camera.distance = self.elevation_deg, self.distance
        return camera


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What the thumbnail of a task shows.

    Attributes:
        share: Time of the moment, as a share of the episode, 0 (start) to 1 (end).
        view: Where the camera stands.
    """

    share: float
    view: View = View()


MOMENTS = {
    "LiftBox": Moment(share=0.9, view=View(distance=1.9, height=0.65)),
    "PressCube": Moment(share=0.9),
    "PushCube": Moment(share=0.8),
    "Handover": Moment(share=0.8),
    "GraspCube": Moment(share=0.8),
    "OpenCabinet": Moment(share=0.9, view=View(azimuth_deg=-65.0, distance=1.9)),
    "PushCart": Moment(share=0.8, view=View(distance=1.9, height=0.65)),
    "EraseBoard": Moment(share=0.8, view=View(azimuth_deg=-40.0, elevation_deg=-12.0, distance=1.6, height=0.95)),
    "PourWater": Moment(share=0.75),
    "ExchangeCube": Moment(share=0.7),
    "StackCube": Moment(share=0.95),
    "CarryBox": Moment(share=0.6, view=View(distance=2.2, height=0.65)),
}
"""The moment of each task, chosen by eye."""

FILM_VIEW = View(azimuth_deg=130.0, elevation_deg=-12.0, distance=2.3, height=0.6, towards=0.3)


class Painter:
    """Draws moments of one take from a camera of its own, with shadows and smooth edges.

    Args:
        take: The episode.
        width: Of a picture [px]; its height is three quarters of it.
    """

    def __init__(self, take: Take, width: int) -> None:
        self._take, self._size = take, (width, round(width * HEIGHT / WIDTH))
        self._sim = take.world()
        self._sim.model.vis.quality.shadowsize = SHADOW_SIZE
        self._renderer = Renderer(self._sim.model, shadows=True)

    def camera(self, view: View, index: int) -> mujoco.MjvCamera:
        """Return the camera of a view of step ``index``."""
        self._sim.restore(self._take.snapshots[index])
        return view.camera(self._sim.pose("pelvis")[0], self._sim.pose(self._take.task.objects[0].name)[0, :3, 3])

    def paint(self, index: int, camera: mujoco.MjvCamera) -> Image.Image:
        """Return the picture of step ``index``; it is drawn at 640 x 480 and made smaller, which smooths edges."""
        self._sim.restore(self._take.snapshots[index])
        picture = Image.fromarray(self._renderer.render(self._sim.mj_data(), camera))
        return picture.resize(self._size, Image.Resampling.LANCZOS)

    def close(self) -> None:
        """Release the simulation and the graphics context."""
        self._renderer.close()
        self._sim.close()


def thumbnail(take: Take, moment: Moment, width: int) -> Image.Image:
    """Return the picture of a task's moment.

    Args:
        take: An episode of the task.
        moment: Which step to show, and from where.
        width: Of the picture [px].
    """
    index = round(moment.share * (len(take.snapshots) - 1))
    painter = Painter(take, width)
    try:
        return painter.paint(index, painter.camera(moment.view, index))
    finally:
        painter.close()


def film(takes: Sequence[Take], width: int) -> list[Image.Image]:
    """Return the frames of a film that shows takes side by side; a take that ends early keeps its last picture.

    The cameras stand still, where the view of each take's last step puts them.

    Args:
        takes: From left to right.
        width: Of one take's pictures [px].
    """
    last = max(len(take.snapshots) for take in takes) - 1
    frames = []
    with ExitStack() as stack:
        painters = [Painter(take, width) for take in takes]
        for painter in painters:
            stack.callback(painter.close)
        cameras = [
            painter.camera(FILM_VIEW, len(take.snapshots) - 1) for painter, take in zip(painters, takes, strict=True)
        ]
        for step in range(0, last + FILM_STRIDE, FILM_STRIDE):
            pictures = [
                painter.paint(min(step, len(take.snapshots) - 1), camera)
                for painter, take, camera in zip(painters, takes, cameras, strict=True)
            ]
            frame = Image.new("RGB", (sum(picture.width for picture in pictures), pictures[0].height))
            for place, picture in enumerate(pictures):
                frame.paste(picture, (place * picture.width, 0))
            frames.append(frame)
    return frames


def write_film(frames: Sequence[Image.Image], path: Path, quality: int) -> None:
    """Write an animated WebP that repeats for ever.

    Args:
        frames: Of one size.
        path: The file.
        quality: 0 (small) to 100 (fine).
    """
    durations = [FILM_FRAME_MS] * (len(frames) - 1) + [FILM_LAST_MS]
    frames[0].save(
        path, save_all=True, append_images=list(frames[1:]), duration=durations, loop=0, quality=quality, method=6
    )


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """Draw the pictures of the README.

    Attributes:
        root: Folder of the pictures; existing ones are replaced.
        policy: ``pretrained_model`` directory of a policy for LiftBox; without one no film is drawn.
        policy_region: Initial region of the policy's rollout.
        policy_seed: Seed of the rollout's start.
        tasks: Tasks whose thumbnails are drawn.
        thumbnail_width: Width of a thumbnail [px].
        film_width: Width of one half of the film [px].
        quality: Quality of the pictures, 0 to 100.
    """

    root: Path = Path("docs/pictures")
    policy: Path | None = None
    policy_region: str = "R1"
    policy_seed: int = 1_000_000
    tasks: tuple[str, ...] = tuple(MOMENTS)
    thumbnail_width: int = 320
    film_width: int = 400
    quality: int = 80


def draw(pictures: Pictures) -> list[Path]:
    """Draw the pictures and return their files.

    Raises:
        UnknownNameError: A task does not exist.
        PolicyError: The policy cannot be read, or is not one for LiftBox.
    """
    tasks = [get_task(name) for name in pictures.tasks]
    pictures.root.mkdir(parents=True, exist_ok=True)
    written = []
    for task in tasks:
        take = generated_take(task, REGION, SEED, INDEX)
        path = pictures.root / f"{task.module.rpartition('.')[2]}.webp"
        picture = thumbnail(take, MOMENTS.get(task.name, Moment(share=0.9)), pictures.thumbnail_width)
        picture.save(path, quality=pictures.quality, method=6)
        written.append(path)
        print(f"{path}: {take.caption}", flush=True)
    if pictures.policy is not None:
        task = get_task(FILM_TASK)
        takes = [
            generated_take(task, REGION, SEED, INDEX),
            policy_take(task, pictures.policy_region, pictures.policy_seed, pictures.policy),
        ]
        path = pictures.root / FILM_NAME
        write_film(film(takes, pictures.film_width), path, pictures.quality)
        written.append(path)
        print(f"{path}: {'; '.join(take.caption for take in takes)}", flush=True)
    return written


if __name__ == "__main__":
    draw(tyro.cli(Pictures))
