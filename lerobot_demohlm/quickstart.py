"""Nothing -> a dataset, a policy trained on it, its score, a video and a report, in some minutes on two cores."""

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm.envs.rendering import Renderer
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import PolicyError, SceneError
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets.facts import read_facts, require_new_root
from lerobot_demohlm.policies.training import train

BATCH_SIZE = 128
"""Samples a training step: a quarter of the preset's. Half the steps instead cost as much and lose success."""
NETWORK = {"hidden_dims": [512, 1024, 512]}
"""Half as wide in the middle as the preset's network: 0.87 of the training's CPU time, and as much success."""
WIDEST = "R3"  # region of the benchmark


@dataclass(frozen=True, kw_only=True)
class Quickstart:
    """What the quickstart does.

    Attributes:
        root: Directory of everything that it writes; must not exist.
        task: Name of the task.
        region: Initial region of the data. The policy is scored there and in R3, the paper's widest region.
        num_episodes: Episodes generated.
        steps: Training steps of 128 samples.
        num_rollouts: Rollouts scored in each region.
        num_workers: Processes that generate, and threads that roll out.
        seed: Of the generation and of the training.
    """

    root: Path
    task: str = "LiftBox"
    region: str = "R1"
    num_episodes: int = 100
    steps: int = 2500
    num_rollouts: int = 50
    num_workers: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the counts."""
        for name in ("num_episodes", "steps", "num_rollouts", "num_workers"):
            if getattr(self, name) < 1:
                raise PolicyError(f"{name}={getattr(self, name)}", "1 or more", f"correct --{name.replace('_', '-')}")


class Recorder:
    """Keeps pictures of the first episode of the first batch; give it to ``rollouts`` as ``on_step``.

    Attributes:
        frames: (height, width, 3) uint8 each; none on a machine that has nothing to draw with.
    """

    def __init__(self) -> None:
        self.frames: list[np.ndarray] = []
        self._renderer: Renderer | None = None
        self._done = False

    def __call__(self, env: DemoHLMVectorEnv, going: np.ndarray) -> None:
        """Take a picture of world 0, up to and with the end of its episode."""
        if self._done:
            return
        if self._renderer is None:
            self._renderer = Renderer(env.sim.model)
        try:
            self.frames.append(self._renderer.render(env.sim.mj_data(0)))
        except SceneError as error:
            _say(f"No pictures: {error}")
            self._done = True
            return
        if not going[0]:
            self._done = True
            self._renderer.close()


def run(quickstart: Quickstart) -> Path:
    """Do it all and return the path of the report.

    Raises:
        DatasetError: The root exists, or no attempt succeeded.
    """
    require_new_root(quickstart.root)
    get_task(quickstart.task).region(quickstart.region)
    _say(f"Everything goes to {quickstart.root}")
    durations: dict[str, float] = {}
    dataset_root = quickstart.root / "dataset"

    with _step(durations, 1, f"Generating {quickstart.num_episodes} episodes from one demonstration"):
        from lerobot_demohlm.generation.request import GenerationRequest
        from lerobot_demohlm.generation.runner import generate

        summary = generate(
            GenerationRequest(
                task=quickstart.task,
                region=quickstart.region,
                seed=quickstart.seed,
                root=dataset_root,
                num_episodes=quickstart.num_episodes,
                num_workers=quickstart.num_workers,
            )
        )
        _say(
            f"{summary.successes} of {summary.attempts} attempts succeeded, "
            f"{summary.episodes_per_hour:.0f} episodes an hour"
        )

    with _step(durations, 2, f"Training the chunked MLP, {quickstart.steps} steps of {BATCH_SIZE} samples"), _quiet():
        checkpoint = train(
            quickstart.root / "train",
            dataset_root,
            steps=quickstart.steps,
            seed=quickstart.seed,
            batch_size=BATCH_SIZE,
            options=NETWORK,
        )

    regions = list(dict.fromkeys([quickstart.region, WIDEST]))
    scoring = f"Scoring {quickstart.num_rollouts} rollouts in {' and in '.join(regions)} from starts it has not seen"
    with _step(durations, 3, scoring):
        from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, evaluate, summarize
        from lerobot_demohlm.evaluation.loaded_policy import load_policy
        from lerobot_demohlm.evaluation.rollouts import Setting

        recorder = Recorder()
        with _quiet():
            loaded = load_policy(checkpoint, quickstart.task)
        scored = {
            region: evaluate(
                loaded,
                Setting(task=quickstart.task, region=region, num_threads=quickstart.num_workers),
                range(FIRST_SEED, FIRST_SEED + quickstart.num_rollouts),
                quickstart.root / ("rollouts.jsonl" if region == quickstart.region else f"rollouts_{region}.jsonl"),
                on_step=recorder if region == quickstart.region else None,
            )
            for region in regions
        }
        for region in regions:
            success = summarize(scored[region])["success_strict"]
            where = (
                "the region of the data"
                if region == quickstart.region
                else "the paper's widest region, without data of it"
            )
            low, high = success["interval"]
            _say(
                f"Success in {region}, {where}: {100 * success['rate']:.0f} % "
                f"(95 % interval {100 * low:.0f} to {100 * high:.0f} %)"
            )
        rollouts = scored[quickstart.region]

    with _step(durations, 4, "Writing video and report"):
        from lerobot_demohlm.reports.films import Film, write_video
        from lerobot_demohlm.reports.report import render_report

        first = rollouts[0]
        caption = f"Rollout from seed {first.seed}: {first.outcome.replace('_', ' ')} after {first.length_s:.1f} s"
        film = Film(frames=recorder.frames, caption=caption)
        video = quickstart.root / "rollout.mp4" if film.frames else None
        if video is not None:
            write_video(video, film)
        page = render_report(
            title=f"{quickstart.task}: from one demonstration to a policy",
            facts=read_facts(dataset_root),
            rollouts=rollouts,
            films=[film] if film.frames else [],
            video=video,
            video_caption=caption,
            durations=durations,
        )
        report = quickstart.root / "report.html"
        report.write_text(page)
    _say(f"{sum(durations.values()) / 60:.1f} minutes in all. Open {report}")
    return report


@contextmanager
def _step(durations: dict[str, float], number: int, text: str) -> Iterator[None]:
    """Announce a step and note how long it took."""
    _say(f"[{number}/4] {text}")
    start = time.monotonic()
    yield
    durations[text] = time.monotonic() - start
    _say(f"[{number}/4] done in {durations[text]:.0f} s")


@contextmanager
def _quiet() -> Iterator[None]:
    """Hold back what LeRobot logs and prints; its progress bar, on stderr, stays."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    stdout = sys.stdout
    try:
        with open(os.devnull, "w") as sys.stdout:
            yield
    finally:
        sys.stdout = stdout
        logging.disable(before)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
