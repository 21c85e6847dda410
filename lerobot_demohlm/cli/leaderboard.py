"""``demohlm leaderboard``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm leaderboard``.

    Attributes:
        policy: A pretrained_model directory of `demohlm train` or lerobot-train.
        task: Name of the task that it is to do.
        output: Directory for the result file, its card and the rollouts.
        trial: Rollouts in each setting instead of the protocol's, to try it out; the result is marked as none.
        num_workers: Processes.
        device: Where the policy runs, such as "cuda".
        check: Result file to check instead: whether it is as it was written.
    """

    policy: Annotated[Path | None, default("none")] = None
    task: Annotated[str | None, default("none")] = None
    output: Path = Path("outputs/leaderboard")
    trial: Annotated[int | None, default("the protocol's")] = None
    num_workers: int = 1
    device: str = "cpu"
    check: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Measure a policy, or check a result; the last line on stdout is the score as JSON.

    Raises:
        DemoHLMError: Neither a policy with its task nor a file to check is given, or both are.
    """
    from lerobot_demohlm.evaluation import leaderboard

    measured = options.policy is not None and options.task is not None
    if measured == (options.check is not None):
        raise DemoHLMError(
            "no policy with its task and no file to check, or both",
            "--policy and --task to measure, or --check",
            "give one of the two",
        )
    if options.check is not None:
        result = leaderboard.read(options.check)
    else:
        import torch

        from lerobot_demohlm.evaluation.loaded_policy import load_policy

        assert options.policy is not None and options.task is not None  # as asked above
        torch.set_num_threads(1)
        loaded = load_policy(options.policy, options.task, options.device)
        result = leaderboard.run(
            loaded, options.task, options.output, num_workers=options.num_workers, trial=options.trial
        )
    print(leaderboard.card(result))
    names = ("task", "policy", "version", "official", "score", "sha256")
    print(json.dumps({name: result[name] for name in names}))
