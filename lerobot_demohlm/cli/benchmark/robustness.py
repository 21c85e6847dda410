"""``demohlm benchmark robustness``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default, spelled


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark robustness``.

    Attributes:
        policy: A pretrained_model directory; without one, nothing is measured, and the lines of --results are shown.
        task: Name of the task, such as LiftBox.
        region: Initial region.
        groups: What varies, one group at a time, each at three strengths.
        num_episodes: Rollouts of each.
        num_workers: Processes.
        results: File to which a line is appended for each.
        figure: Draw all lines in the file of results into this image.
    """

    policy: Annotated[Path | None, default("none")] = None
    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    groups: Annotated[tuple[str, ...], default("all of them")] = ()
    num_episodes: int = 50
    num_workers: int = 1
    results: Path = Path("outputs/robustness.jsonl")
    figure: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Measure, print the table of all lines in Markdown, and draw them.

    Raises:
        UnknownNameError: No such task, region or group.
        PolicyError: The policy does not fit.
    """
    from gym_demohlm.variation.factors import GROUPS
    from lerobot_demohlm.benchmarks.robustness import measure
    from lerobot_demohlm.experiments.robustness import draw, measured, table
    from lerobot_demohlm.reproducibility.results import append_result

    if options.policy is not None:
        import torch

        from lerobot_demohlm.evaluation.loaded_policy import load_policy

        torch.set_num_threads(1)
        loaded = load_policy(options.policy, options.task)
        command = spelled("benchmark robustness", options, leave_out=("policy", "figure", "num_workers"))
        for line in measure(
            loaded,
            options.task,
            options.region,
            options.groups or GROUPS,
            options.num_episodes,
            num_workers=options.num_workers,
        ):
            append_result(options.results, command, line)
            strict = line["success_strict"]["rate"]
            print(f"{line['task']} {line['group']} x {line['strength']:g}: {100 * strict:.0f} %", flush=True)
    rows = measured(options.results)
    print(table(rows))
    if options.figure is not None:
        draw(rows, options.figure)
