"""``demohlm generate``."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.generation.request import BLOCK_SIZE, GenerationRequest, summary_json

_TARGET = tyro.conf.create_mutex_group(required=True, title="how many")


@dataclass(frozen=True, kw_only=True)
class Options(GenerationRequest):
    """Options of ``demohlm generate``.

    Attributes:
        root: Directory of the dataset; must not exist.
        num_episodes: Stop at this many successful episodes, or after 512 attempts without one.
        num_attempts: Make this many attempts, successful or not.
        num_workers: Blocks of attempts that are made at a time.
        backend: Where attempts run: local processes or a Ray cluster.
        resume: Only go on with a run that was begun at the root. Without it the same command also goes on, but begins a
            run where there is none.
        keep_failures: Write failed attempts to a second dataset, ROOT-failures.
    """

    region: str = DEFAULT_REGION
    seed: int = 0
    num_episodes: Annotated[int | None, _TARGET, default("none")] = None
    num_attempts: Annotated[int | None, _TARGET, default("none")] = None
    demonstration: Annotated[Path | None, default("the packaged one")] = None
    repo_id: Annotated[str | None, default("made from task and region")] = None
    variation: tyro.conf.OmitArgPrefixes[DataVariation] = field(default_factory=DataVariation)
    cameras: Annotated[tuple[str, ...] | None, default("no pictures")] = None
    block_size: tyro.conf.Suppress[tyro.conf.Fixed[int]] = BLOCK_SIZE
    show_progress: tyro.conf.Suppress[tyro.conf.Fixed[bool]] = True


def run(options: Options) -> None:
    """Generate a dataset; the last line on stdout is the summary as JSON."""
    from lerobot_demohlm.generation.runner import generate

    print(json.dumps(summary_json(generate(options))))
