"""``demohlm benchmark training``."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli.choices import Policy, Preset
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark training``.

    Attributes:
        root: Dataset of `demohlm generate`.
        num_episodes: Episodes of random numbers, where no dataset is given.
        policies: Policies to train.
        preset: Hyperparameters.
        steps: Training steps, of which the second half counts.
    """

    root: Annotated[Path | None, default("random numbers")] = None
    num_episodes: int = 100
    policies: tuple[Policy, ...] = get_args(Policy)
    preset: Preset = "cpu"
    steps: int = 60


def run(options: Options) -> None:
    """Measure; a JSON line a policy on stdout.

    Raises:
        DatasetError: A count is too small.
        PolicyError: A training failed.
    """
    from lerobot_demohlm.benchmarks.loading import write_random_dataset
    from lerobot_demohlm.benchmarks.training import measure

    for name, least in (("num_episodes", 1), ("steps", 2)):
        if (value := getattr(options, name)) < least:
            raise DatasetError(f"{name}={value}", f"{least} or more", f"correct --{name.replace('_', '-')}")
    with tempfile.TemporaryDirectory() as scratch:
        root = options.root
        if root is None:
            root = Path(scratch) / "random"
            write_random_dataset(root, options.num_episodes)
        for policy in options.policies:
            print(json.dumps(measure(root, policy, options.preset, options.steps)), flush=True)
