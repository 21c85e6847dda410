"""Episodes -> films: simulated once and kept as snapshots, a picture drawn when a strip or a video needs it."""

import io
import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from gym_demohlm.timing import FPS, STEP_DT
from gym_demohlm.variation import Variation, get_variation
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.stages import Settings

CAMERAS = {"overview": "A fixed camera", "head": "The robot's head camera"}
STRIP_FRAMES, STRIP_WIDTH = 6, 320  # frames of a strip, and the width of one [px]
SHADOW_SIZE = 8192  # of the map of shadows [px]; a smaller one leaves specks on the floor
Snapshot = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Film:
    """Pictures of one episode.

    Attributes:
        frames: (T, height, width, 3) uint8.
        caption: What it shows.
        fps: Frames a second of simulated time.
    """

    frames: Sequence[np.ndarray]
    caption: str
    fps: int = FPS


def film_strip(film: Film, count: int = 8, width: int = 240) -> bytes:
    """Return a PNG of frames from the first to the last, two rows, each with its time.

    Args:
        film: What to show.
        count: Frames shown, at most; even numbers fill the rows.
        width: Of a frame [px].
    """
    chosen = np.unique(np.linspace(0, len(film.frames) - 1, count).round().astype(int))
    height = round(width * film.frames[0].shape[0] / film.frames[0].shape[1])
    columns = math.ceil(len(chosen) / 2)
    strip = Image.new("RGB", (columns * width, math.ceil(len(chosen) / columns) * height), "white")
    for place, index in enumerate(chosen):
        picture = Image.fromarray(film.frames[index]).resize((width, height), Image.Resampling.LANCZOS)
        ImageDraw.Draw(picture).text(
            (6, 4), f"{index / film.fps:.1f} s", fill="white", stroke_width=1, stroke_fill="black"
        )
        strip.paste(picture, (place % columns * width, place // columns * height))
    stream = io.BytesIO()
    strip.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def write_video(path: Path, film: Film) -> None:
    """Write a film as MP4."""
    from lerobot.utils.io_utils import write_video as write

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, list(film.frames), film.fps)


@dataclass(frozen=True, kw_only=True)
class Take:
    """One episode, to be drawn.

    Attributes:
        task: What it is an episode of.
        variation: What may differ from world to world.
        initial_state: Of the episode, with the conditions of its world.
        snapshots: Of a simulation with one world, from the start to the end, one a step.
        origin: What made it: region, seed and attempt, or the policy.
        outcome: How it ended.
        length_s: Simulated time [s].
    """

    task: Task
    variation: Variation
    initial_state: InitialState
    snapshots: Sequence[Snapshot]
    origin: str
    outcome: str
    length_s: float

    @property
    def caption(self) -> str:
        """Return where it comes from, how it ended and how long it took."""
        return f"{self.origin}: {self.outcome.replace('_', ' ')} after {self.length_s:.1f} s"

    def world(self) -> Simulation:
        """Return a simulation of the episode's world, at its start."""
        sim = Simulation(self.task, variation=self.variation)
        sim.reset([self.initial_state])
        return sim


class Shots(Sequence[np.ndarray]):
    """The frames of a take as one camera sees them, each drawn when it is asked for.

    Args:
        take: The episode.
        sim: Its world, moved about to be drawn.
        camera: Which of ``CAMERAS``.
        renderer: Of the simulation's model.
    """

    def __init__(self, take: Take, sim: Simulation, camera: str, renderer: Renderer) -> None:
        self._take, self._sim, self._camera, self._renderer = take, sim, camera, renderer

    def __len__(self) -> int:
        return len(self._take.snapshots)

    def __getitem__(self, index: int) -> np.ndarray:
        self._sim.restore(self._take.snapshots[index])
        return self._renderer.render(self._sim.mj_data(), self._camera)


def generated_take(
    task: Task,
    region: str,
    seed: int,
    index: int,
    demonstration: Path | None = None,
    controller: str | None = None,
    variation: str = "none",
) -> Take:
    """Make one attempt, the one that ``demohlm generate`` makes with this seed by default.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        index: Of the attempt.
        demonstration: Directory of the demonstration; the packaged one by default.
        controller: Name, path or hash of the whole-body controller; the default one by default.
        variation: How worlds differ, as "real".
    """
    task.region(region)
    snapshots: list[Snapshot] = []
    source = demonstrations.load(demonstration, task)
    settings = Settings(variation=DataVariation(variation=variation))
    attempts = Attempts(
        task,
        source,
        region,
        seed,
        settings=settings,
        on_step=lambda sim: snapshots.append(sim.snapshot()),
        controller=controller,
    )
    (episode,) = attempts.run([index])
    attempts.close()
    return Take(
        task=attempts.task,
        variation=get_variation(variation),
        initial_state=episode.initial_state,
        snapshots=snapshots,
        origin=f"{_place(region, variation)}, seed {seed}, attempt {index}",
        outcome=episode.outcome,
        length_s=episode.length_s,
    )


def policy_take(
    task: Task, region: str, seed: int, policy: Path, variation: str = "none", perception: str = "exact"
) -> Take:
    """Roll a policy out once.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the start, as in ``demohlm evaluate``.
        policy: ``pretrained_model`` directory of a checkpoint.
        variation: How worlds differ, as "real".
        perception: How observation and gaze see objects, as "rgbd".
    """
    from lerobot_demohlm.evaluation.loaded_policy import load_policy  # loads torch and lerobot's policies
    from lerobot_demohlm.evaluation.rollouts import Setting, rollouts

    snapshots: list[Snapshot] = []

    def keep(env: DemoHLMVectorEnv, _going: np.ndarray) -> None:
        snapshots.append(env.sim.snapshot())

    setting = Setting(task=task.name, region=region, num_worlds=1, variation=variation, perception=perception)
    (rollout,) = rollouts(load_policy(policy, task.name), setting, [seed], on_step=keep)
    return Take(
        task=task.at(region),
        variation=get_variation(variation),
        initial_state=dict(rollout.initial_state),
        snapshots=snapshots,
        origin=f"{rollout.policy}, {_place(region, variation)}, seed {seed}",
        outcome=rollout.outcome,
        length_s=STEP_DT * (len(snapshots) - 1),
    )


def _place(region: str, variation: str) -> str:
    return f"{region} under {variation}" if get_variation(variation) else region


def write_take(
    take: Take,
    root: Path,
    width: int = WIDTH,
    videos: bool = True,
    strips: bool = True,
    cameras: Sequence[str] = tuple(CAMERAS),
) -> None:
    """Write ``TASK_CAMERA.png`` and ``TASK_CAMERA.mp4`` for each camera.

    Args:
        take: The episode.
        root: Directory; made where it does not exist.
        width: Of what is drawn [px]. Strips are made smaller, which smooths edges, and kept in 256 colours, which
            halves the bytes. Strips of the fixed camera have shadows; the head camera's show what a policy sees.
        videos: Whether videos are written.
        strips: Whether film strips are written.
        cameras: Which of ``CAMERAS``.
    """
    root.mkdir(parents=True, exist_ok=True)
    sim, height = take.world(), round(width * HEIGHT / WIDTH)
    if strips:
        sim.model.vis.quality.shadowsize = SHADOW_SIZE
    stem = take.task.slug
    with ExitStack() as stack:
        stack.callback(sim.close)
        plain = stack.enter_context(Renderer(sim.model, width, height))
        if strips:
            shaded = plain
            if "overview" in cameras:
                shaded = stack.enter_context(Renderer(sim.model, width, height, shadows=True))
            for camera in cameras:
                renderer = shaded if camera == "overview" else plain
                film = Film(frames=Shots(take, sim, camera, renderer), caption=take.caption)
                strip = Image.open(io.BytesIO(film_strip(film, STRIP_FRAMES, min(width, STRIP_WIDTH))))
                strip.quantize(256, dither=Image.Dither.NONE).save(root / f"{stem}_{camera}.png", optimize=True)
        if videos:
            for camera in cameras:
                film = Film(frames=Shots(take, sim, camera, plain), caption=take.caption)
                write_video(root / f"{stem}_{camera}.mp4", film)
