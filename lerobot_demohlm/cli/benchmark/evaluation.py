"""``demohlm benchmark evaluation``."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import PolicyError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.evaluation.rollouts import NUM_WORLDS, Setting


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark evaluation``.

    Attributes:
        policy: A pretrained_model directory.
        task: Name of the task.
        region: Initial region, R1 to R4.
        num_episodes: Rollouts of `demohlm evaluate`.
        num_lerobot_episodes: Rollouts of lerobot-eval.
        lerobot_batch_size: Worlds at a time of lerobot-eval.
        num_workers: Processes of `demohlm evaluate`.
    """

    policy: Annotated[Path | None, default("one that stands still")] = None
    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    num_episodes: int = 4 * NUM_WORLDS
    num_lerobot_episodes: int = 50
    lerobot_batch_size: Annotated[int | None, default("LeRobot's choice")] = None
    num_workers: int = 2


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        PolicyError: The policy does not fit, or a count is not positive.
    """
    import torch

    from gym_demohlm.registry import get_task
    from lerobot_demohlm.benchmarks.evaluation import measure, write_standing_policy

    for name in ("num_episodes", "num_lerobot_episodes"):
        if getattr(options, name) < 1:
            raise PolicyError(f"{name}={getattr(options, name)}", "1 or more", f"correct --{name.replace('_', '-')}")
    setting = Setting(task=options.task, region=options.region, num_workers=options.num_workers)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        policy = options.policy or write_standing_policy(Path(scratch) / "pretrained_model", get_task(options.task))
        counts = (options.num_episodes, options.num_lerobot_episodes, options.lerobot_batch_size)
        print(json.dumps(measure(policy, setting, *counts)))
