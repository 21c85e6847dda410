"""``demohlm benchmark loading``."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark loading``.

    Attributes:
        root: Dataset of `demohlm generate`.
        num_episodes: Episodes of random numbers, where no dataset is given.
        chunk: Actions a sample.
        batch_size: Samples a batch.
        rounds: Turns of LeRobot's loader and of ours.
        batches: Batches from memory, a turn.
    """

    root: Annotated[Path | None, default("random numbers")] = None
    num_episodes: int = 100
    chunk: int = 20
    batch_size: int = 512
    rounds: int = 3
    batches: int = 20


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: A count is not positive.
    """
    from lerobot_demohlm.benchmarks.loading import measure, write_random_dataset

    counts = {name: getattr(options, name) for name in ("chunk", "batch_size", "rounds", "batches")}
    for name, value in {**counts, "num_episodes": options.num_episodes}.items():
        if value < 1:
            raise DatasetError(f"{name}={value}", "1 or more", f"correct --{name.replace('_', '-')}")
    with tempfile.TemporaryDirectory() as scratch:
        root = options.root
        if root is None:
            root = Path(scratch) / "random"
            write_random_dataset(root, options.num_episodes)
        print(json.dumps(measure(root, **counts)))
