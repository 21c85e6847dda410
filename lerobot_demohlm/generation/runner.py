"""What to generate -> workers that make blocks of attempts -> one dataset, the same whatever their number and place.

A block of consecutive attempts is made by one worker as worlds of one simulation and appears on disk by one rename; the
blocks on disk are the only memory of a run. So a run may be killed at any time, and the same call resumes it; a worker
may be killed, and another makes its block again.
"""

import functools
import importlib
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from tqdm import tqdm

from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError, DemoHLMError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.task import Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.cameras import PictureFacts
from lerobot_demohlm.datasets.facts import GenerationFacts, installed_versions, perception_fit
from lerobot_demohlm.datasets.hub import require_repo_id
from lerobot_demohlm.datasets.wordings import wordings
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import require_approach, segment
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.block import storing, write_block
from lerobot_demohlm.generation.request import Backend, GenerationRequest, GenerationSummary
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.generation.workers import ProcessWorkers, Workers
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.reproducibility.processes import hush_torchcodec

if TYPE_CHECKING:
    from lerobot_demohlm.generation.painting import Painter, StateRecorder

MAX_DEATHS = 3  # of workers at one block, before the run gives up


def generate(request: GenerationRequest) -> GenerationSummary:
    """Generate a dataset; a killed call is resumed by the same call.

    Raises:
        UnknownNameError: No such task, region or controller.
        SceneError: The controller's file is missing or damaged.
        DemonstrationError: The demonstration cannot be read, is of another task or version, or touches nothing.
        DatasetError: The root exists or cannot be written, a run with other arguments was begun there, another process
            is at work there, or no attempt succeeded.
        KeyboardInterrupt: Stopped from the keyboard; it says what is kept.
    """
    hush_torchcodec()
    task = get_task(request.task)
    task.region(request.region)
    if request.repo_id is not None:
        require_repo_id(request.repo_id)
    if request.num_workers < 1 or request.seed < 0:
        raise DatasetError(
            f"num_workers={request.num_workers}, seed={request.seed}",
            "at least 1 worker and a seed of 0 or more",
            "correct --num-workers or --seed",
        )
    demonstration = demonstrations.load(request.demonstration, task)
    require_approach(segment(demonstration, task))  # fails now rather than in a worker
    weights = controllers.load(request.controller)
    pictures = PictureFacts.of(request.cameras or (), request.light, request.texture, request.camera_shift)
    if pictures.cameras:
        from lerobot_demohlm.generation.painting import Painter  # loads a graphics library

        Painter(
            task.at(request.region), pictures, get_variation(request.variation.variation)
        ).close()  # fails now where there is nothing to draw with
    facts = GenerationFacts(
        task=task.name,
        task_text=task.description,
        region=request.region,
        seed=request.seed,
        demonstration_hash=demonstration.content_hash,
        controller_hash=weights.hash,
        model_hash=provenance.model_hash(build_scene(task.at(request.region), weights.settings.physics).model),
        num_episodes=request.num_episodes,
        num_attempts=request.num_attempts,
        block_size=request.block_size,
        keep_failures=request.keep_failures,
        variation=request.variation,
        pictures=pictures,
        wordings=request.wordings,
        perception_fit=perception_fit(task, request.variation.content()),
    )
    repo_id = request.repo_id or f"demohlm/{task.slug}_{request.region.lower()}"
    run = GenerationRun.open(Path(request.root), repo_id, facts, resume=request.resume)
    try:
        began, found = time.monotonic(), run.num_successes
        if not run.target_met():
            maker = BlockMaker(
                facts=facts,
                demonstration=demonstration,
                task_module=task.module,
                controller=request.controller,
            )
            with closing(_workers(maker, run, request)) as workers, _Progress(run, request.show_progress) as progress:
                make_blocks(run, workers, progress.update)
        made, elapsed = run.num_successes - found, time.monotonic() - began
        content = run.finish()
    except KeyboardInterrupt:
        if not run.directory.exists():
            raise KeyboardInterrupt(f"the dataset is whole, in {run.root}") from None
        kept = f"{run.num_attempts} attempts are kept in {run.directory}"
        raise KeyboardInterrupt(f"{kept}; the same command goes on from there") from None
    finally:
        run.close()
    kept = ("task", "region", "seed", "attempts", "successes", "success_rate", "outcomes", "first_try_successes")
    kept = (*kept, "strict_successes")
    return GenerationSummary(
        **{key: content[key] for key in kept},
        variation=request.variation,
        episodes_per_hour=round(3600.0 * made / elapsed, 1),
    )


def make_blocks(run: GenerationRun, workers: Workers, report: Callable[[], None] = lambda: None) -> None:
    """Keep the workers busy until the target is met; a block whose worker dies is given to another.

    Args:
        run: Where blocks are missing.
        workers: What makes the blocks.
        report: Called after each block.

    Raises:
        DemoHLMError: Workers keep dying at one block, or one could not make it.
    """
    pending, again, deaths = run.pending_blocks(), deque[range](), Counter[range]()
    while not run.target_met():
        while workers.free > 0:
            attempts = again.popleft() if again else next(pending, None)
            if attempts is None:
                break
            workers.submit(attempts)
        for block in workers.wait():
            if run.is_done(block.attempts):
                report()
                continue
            deaths[block.attempts] += 1
            if deaths[block.attempts] == MAX_DEATHS:
                first, last = block.attempts.start, block.attempts.stop - 1
                raise DemoHLMError(
                    f"{MAX_DEATHS} workers that died at attempts {first} to {last}, the last one "
                    f"{block.death or 'after its block, which cannot be read'}",
                    "workers that finish",
                    "give them more memory or start fewer of them; the same command goes on",
                )
            again.append(block.attempts)


@dataclass(frozen=True, kw_only=True)
class BlockMaker:
    """Makes blocks of a run in a worker, which need not be of this machine.

    Attributes:
        facts: The run's facts.
        demonstration: The run's demonstration.
        task_module: Name of the module that registers the task.
        controller: Name, path or hash of the whole-body controller.
        code: Hashes of the code that simulates, judges and generates, where the run was begun or taken up.
    """

    facts: GenerationFacts
    demonstration: Demonstration
    task_module: str
    controller: str = controllers.DEFAULT
    code: str = field(init=False)

    def __post_init__(self) -> None:
        """Note the code."""
        object.__setattr__(self, "code", _code(get_task(self.facts.task)))

    def __call__(self, directory: Path, attempts: range) -> None:
        """Make attempts and write their block into a run's directory."""
        if self._recorder is not None:
            self._recorder.clear()
        episodes = self._attempts.run(attempts)
        if self.facts.wordings:
            known = wordings(get_task(self.facts.task))
            episodes = [replace(episode, task_text=known[episode.index % len(known)]) for episode in episodes]
        if self._recorder is None:
            write_block(directory, self.facts, attempts, episodes)
            return
        blocks = directory / "blocks"  # where what a killed worker leaves is removed with the run
        with storing(directory), tempfile.TemporaryDirectory(dir=blocks, prefix=".painted-") as folder:
            drawn = self._painter.paint(episodes, self._recorder, Path(folder))
            write_block(directory, self.facts, attempts, episodes, drawn)

    @functools.cached_property
    def _recorder(self) -> "StateRecorder | None":
        if not self.facts.pictures.cameras:
            return None
        from lerobot_demohlm.generation.painting import StateRecorder

        return StateRecorder()

    @functools.cached_property
    def _painter(self) -> "Painter":
        from lerobot_demohlm.generation.painting import Painter

        varied = get_variation(self.facts.variation.variation)
        return Painter(get_task(self.facts.task).at(self.facts.region), self.facts.pictures, varied)

    @functools.cached_property
    def _attempts(self) -> Attempts:
        facts = self.facts
        _require_same(installed_versions(), facts.versions)
        importlib.import_module(self.task_module)
        task = get_task(facts.task)
        here = _code(task), controllers.load(self.controller).hash, perception_fit(task, facts.variation.content())
        begun = self.code, facts.controller_hash, facts.perception_fit
        names = "code", "controller", "fit of perception"
        _require_same(dict(zip(names, here, strict=True)), dict(zip(names, begun, strict=True)))
        return Attempts(
            task,
            self.demonstration,
            facts.region,
            facts.seed,
            facts.block_size,
            Settings(variation=facts.variation),
            on_step=self._recorder,
            controller=self.controller,
        )


def _code(task: Task) -> str:
    return f"{provenance.simulation_hash(task)} {provenance.generator_hash()}"


def _require_same(found: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Raise ``DatasetError`` where a worker differs from what its run was begun with."""
    for name, wanted in expected.items():
        if found.get(name) != wanted:
            raise DatasetError(
                f"a worker with {name} {found.get(name)}",
                f"{name} {wanted}, as where the run was begun: other bits would come of it",
                "install the same on all machines, and use one family of processors",
            )


def _workers(maker: BlockMaker, run: GenerationRun, request: GenerationRequest) -> Workers:
    if request.backend == "processes":
        return ProcessWorkers(maker, run.directory, request.num_workers)
    if request.backend != "ray":
        raise UnknownNameError("backend", request.backend, get_args(Backend))
    try:
        from lerobot_demohlm.generation.ray_workers import RayWorkers
    except ModuleNotFoundError as error:
        raise DemoHLMError("an installation without ray", "the extra [ray]", "uv sync --extra ray") from error
    return RayWorkers(maker, run.directory, request.num_workers)


class _Progress:
    """A bar on stderr that counts towards the target, with the success rate behind it."""

    def __init__(self, run: GenerationRun, shown: bool) -> None:
        self._run, facts = run, run.facts
        self._counts_episodes = facts.num_episodes is not None
        self._bar = tqdm(
            total=facts.num_episodes or facts.num_attempts,
            desc=f"{facts.task} {facts.region}",
            unit="episode" if self._counts_episodes else "attempt",
            disable=not shown,
            smoothing=0.1,
        )
        self._bar.n = self._bar.initial = self._count()
        self.update()

    def _count(self) -> int:
        count = self._run.num_successes if self._counts_episodes else self._run.num_attempts
        return min(count, int(self._bar.total))

    def update(self) -> None:
        """Count what is on disk and draw, whatever the clock on the wall says of the time since the last drawing."""
        attempts = self._run.num_attempts
        if attempts:
            self._bar.set_postfix_str(f"success {self._run.num_successes / attempts:.1%}", refresh=False)
        self._bar.n = self._count()
        self._bar.refresh()

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
