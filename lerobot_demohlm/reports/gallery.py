"""Tasks -> an episode of each as film strips and videos from two cameras, on one HTML page and one for a repository.

An episode is simulated once, generated from the demonstration or rolled out by a policy, and kept as snapshots; a
picture is drawn from its snapshot when a strip or a video needs it.
"""

import argparse
import importlib.resources
import io
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np
from PIL import Image

from gym_demohlm.envs.rendering import HEIGHT, WIDTH, Renderer
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import DEFAULT_REGION, Task
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.datasets.facts import require_new_root
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.reports.report import Film, film_strip, write_video

CAMERAS = {"overview": "A fixed camera", "head": "The robot's head camera"}
STRIP_FRAMES, STRIP_WIDTH = 6, 320  # frames of a strip, and the width of one [px]
SHADOW_SIZE = 8192  # of the map of shadows [px]; a smaller one leaves specks on the floor
Snapshot = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Take:
    """One episode, to be drawn.

    Attributes:
        task: What it is an episode of.
        snapshots: Of a simulation with one world, from the start to the end, one a step.
        origin: What made it: region, seed and attempt, or the policy.
        outcome: How it ended.
        length_s: Simulated time [s].
    """

    task: Task
    snapshots: Sequence[Snapshot]
    origin: str
    outcome: str
    length_s: float

    @property
    def caption(self) -> str:
        """Return where it comes from, how it ended and how long it took."""
        return f"{self.origin}: {self.outcome.replace('_', ' ')} after {self.length_s:.1f} s"


class Shots(Sequence[np.ndarray]):
    """The frames of a take as one camera sees them, each drawn when it is asked for.

    Args:
        take: The episode.
        sim: One world of its task, moved about to be drawn.
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


def generated_take(task: Task, region: str, seed: int, index: int, demonstration: Path | None = None) -> Take:
    """Make one attempt, the one that ``demohlm generate`` makes with this seed by default.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the run.
        index: Of the attempt.
        demonstration: Directory of the demonstration; the packaged one by default.
    """
    task.region(region)
    snapshots: list[Snapshot] = []
    source = demonstrations.load(demonstration, task)
    attempts = Attempts(task, source, region, seed, on_step=lambda sim: snapshots.append(sim.snapshot()))
    (episode,) = attempts.run([index])
    attempts.close()
    origin = f"{region}, seed {seed}, attempt {index}"
    return Take(task=task, snapshots=snapshots, origin=origin, outcome=episode.outcome, length_s=episode.length_s)


def policy_take(task: Task, region: str, seed: int, policy: Path) -> Take:
    """Roll a policy out once.

    Args:
        task: The task.
        region: Initial region.
        seed: Of the start, as in ``demohlm evaluate``.
        policy: ``pretrained_model`` directory of a checkpoint.
    """
    from lerobot_demohlm.evaluation.rollouts import Setting, load_policy, rollouts  # loads torch and lerobot's policies

    snapshots: list[Snapshot] = []

    def keep(env: DemoHLMVectorEnv, _going: np.ndarray) -> None:
        snapshots.append(env.sim.snapshot())

    setting = Setting(task=task.name, region=region, num_worlds=1)
    (record,) = rollouts(load_policy(policy, task.name), setting, [seed], on_step=keep)
    origin = f"{record['policy']}, {region}, seed {seed}"
    return Take(
        task=task,
        snapshots=snapshots,
        origin=origin,
        outcome=record["outcome"],
        length_s=STEP_DT * (len(snapshots) - 1),
    )


def write_take(take: Take, root: Path, width: int = WIDTH, videos: bool = True) -> None:
    """Write ``TASK_CAMERA.png`` and ``TASK_CAMERA.mp4`` for each camera.

    Args:
        take: The episode.
        root: Directory; made where it does not exist.
        width: Of what is drawn [px]; strips are made smaller, which smooths edges, and kept in 256 colours, which
            halves the bytes. Those of the fixed camera have shadows; the head camera's are what a policy sees.
        videos: Whether videos are written too.
    """
    root.mkdir(parents=True, exist_ok=True)
    sim, height = Simulation(take.task), round(width * HEIGHT / WIDTH)
    sim.model.vis.quality.shadowsize = SHADOW_SIZE
    stem = take.task.slug
    with ExitStack() as stack:
        stack.callback(sim.close)
        shaded = stack.enter_context(Renderer(sim.model, width, height, shadows=True))
        plain = stack.enter_context(Renderer(sim.model, width, height))
        for camera in CAMERAS:
            renderer = shaded if camera == "overview" else plain
            film = Film(frames=Shots(take, sim, camera, renderer), caption=take.caption)
            strip = Image.open(io.BytesIO(film_strip(film, STRIP_FRAMES, min(width, STRIP_WIDTH))))
            strip.quantize(256, dither=Image.Dither.NONE).save(root / f"{stem}_{camera}.png", optimize=True)
            if videos:
                film = Film(frames=Shots(take, sim, camera, plain), caption=take.caption)
                write_video(root / f"{stem}_{camera}.mp4", film)


def render_page(takes: Sequence[Take], template: str, folder: str, videos: bool) -> str:
    """Return a page that shows takes.

    Args:
        takes: One a task.
        template: "gallery.html.j2" or "gallery.md.j2".
        folder: Where strips and videos lie, seen from the page.
        videos: Whether there are videos.
    """
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        autoescape=template.endswith(".html.j2"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = (importlib.resources.files("lerobot_demohlm.reports") / "templates" / template).read_text()
    shown = [{"take": take, "stem": take.task.slug} for take in takes]
    return environment.from_string(text).render(shown=shown, cameras=CAMERAS, folder=folder, videos=videos)


def write_markdown(takes: Sequence[Take], root: Path, page: Path) -> None:
    """Write a Markdown page, and beside it the strips in a folder of its name.

    Args:
        takes: Written to root before.
        root: Where their strips are.
        page: The file; written over where it exists, as are the strips.
    """
    folder = page.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    for take in takes:
        for camera in CAMERAS:
            name = f"{take.task.slug}_{camera}.png"
            shutil.copyfile(root / name, folder / name)
    page.write_text(render_page(takes, "gallery.md.j2", os.path.relpath(folder, page.parent), videos=False))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm gallery``."""
    parser.add_argument("--task", nargs="+", help="names of tasks, such as LiftBox (default: all)")
    parser.add_argument("--region", default=DEFAULT_REGION, help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the initial states (default: %(default)s)")
    parser.add_argument("--index", type=int, default=0, help="which attempt of that seed (default: %(default)s)")
    parser.add_argument("--demonstration", type=Path, help="directory of the demonstration (default: the packaged one)")
    parser.add_argument("--policy", type=Path, help="pretrained_model to roll out from --seed instead; of one task")
    parser.add_argument("--root", type=Path, required=True, help="directory of pages and films; must not exist")
    parser.add_argument("--markdown", type=Path, help="write a Markdown page too, strips in a folder of its name")
    parser.add_argument("--no-videos", action="store_true", help="strips only, which is many times quicker")


def main(arguments: argparse.Namespace) -> None:
    """Write strips, videos and pages; a task that fails is shown as it failed."""
    require_new_root(arguments.root)
    tasks = [get_task(name) for name in arguments.task] if arguments.task else list(all_tasks().values())
    single = arguments.policy or arguments.demonstration
    if single and len(tasks) != 1:
        raise DatasetError(f"{len(tasks)} tasks for {single}", "one task", "name it with --task")
    if arguments.seed < 0 or arguments.index < 0:
        raise DatasetError(f"seed={arguments.seed}, index={arguments.index}", "0 or more", "change them")
    for task in tasks:
        task.region(arguments.region)
    takes = []
    for task in tasks:
        if arguments.policy:
            take = policy_take(task, arguments.region, arguments.seed, arguments.policy)
        else:
            take = generated_take(task, arguments.region, arguments.seed, arguments.index, arguments.demonstration)
        write_take(take, arguments.root, videos=not arguments.no_videos)
        print(f"{task.name}, {take.caption}", flush=True)
        takes.append(take)
        _write_pages(takes, arguments)  # after each task: a run that is stopped leaves what it has done


def _write_pages(takes: Sequence[Take], arguments: argparse.Namespace) -> None:
    page = arguments.root / "index.html"
    page.write_text(render_page(takes, "gallery.html.j2", ".", videos=not arguments.no_videos))
    if arguments.markdown is not None:
        write_markdown(takes, arguments.root, arguments.markdown)
