"""``demohlm gallery``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm gallery``.

    Attributes:
        task: Names of tasks, such as LiftBox.
        region: Initial region, R1 to R4.
        variation: How worlds differ, as none, real or hard@0.5:objects.
        seed: Seed of the initial states.
        index: Number of the attempt among those of the seed.
        demonstration: Directory of the demonstration, for one task.
        policy: A pretrained_model directory, for one task; its rollout from --seed is drawn instead of an attempt.
        root: Directory of pages and films; must not exist.
        markdown: Write a Markdown page to this file too, with the strips in a folder of its name.
        no_videos: Draw strips only, which is many times quicker.
    """

    task: Annotated[tuple[str, ...] | None, default("all")] = None
    region: str = DEFAULT_REGION
    variation: str = "none"
    seed: int = 0
    index: int = 0
    demonstration: Annotated[Path | None, default("the packaged one")] = None
    policy: Annotated[Path | None, default("none")] = None
    root: Path
    markdown: Annotated[Path | None, default("none")] = None
    no_videos: bool = False


def run(options: Options) -> None:
    """Write strips, videos and pages; a task that fails is shown as it failed."""
    from gym_demohlm.registry import all_tasks, get_task
    from gym_demohlm.variation import get_variation
    from lerobot_demohlm.datasets.facts import require_new_root
    from lerobot_demohlm.reports.films import generated_take, policy_take, write_take
    from lerobot_demohlm.reports.gallery import write_pages

    require_new_root(options.root)
    tasks = [get_task(name) for name in options.task] if options.task else list(all_tasks().values())
    single = options.policy or options.demonstration
    if single and len(tasks) != 1:
        raise DatasetError(f"{len(tasks)} tasks for {single}", "one task", "name it with --task")
    if options.policy and (options.demonstration or options.index):
        raise DatasetError(
            "--policy with --demonstration or --index", "a rollout, or a generated attempt", "leave one of them out"
        )
    if options.seed < 0 or options.index < 0:
        raise DatasetError(f"seed={options.seed}, index={options.index}", "0 or more", "change them")
    for task in tasks:
        task.region(options.region)
    get_variation(options.variation)
    takes = []
    for task in tasks:
        if options.policy:
            take = policy_take(task, options.region, options.seed, options.policy, options.variation)
        else:
            take = generated_take(
                task,
                options.region,
                options.seed,
                options.index,
                options.demonstration,
                variation=options.variation,
            )
        write_take(take, options.root, videos=not options.no_videos)
        print(f"{task.name}, {take.caption}", flush=True)
        takes.append(take)
        # After each task: a run that is stopped leaves what it has done.
        write_pages(takes, options.root, options.markdown, videos=not options.no_videos)
