"""``demohlm benchmark perception``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.cli.parsing import default, spelled
from lerobot_demohlm.cli.printing import print_json

_AXES = ("bias_mm", "latency_s", "dropout", "camera_error", "mesh_scale")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark perception``.

    Attributes:
        policy: A pretrained_model directory; without one, nothing is measured.
        task: Name of the task, such as LiftBox.
        region: Initial region.
        axes: What is varied, one at a time: bias_mm, latency_s, dropout, camera_error, mesh_scale.
        perceptions: Further perceptions, such as rgbd,masks=color or model.
        num_episodes: Rollouts of each.
        num_workers: Processes.
        results: Folder of JSON lines; a line for each is added to its perception_curves.jsonl, and what is in it is not
            measured again.
        figure: Draw the curves of all lines into this image.
    """

    policy: Annotated[Path | None, default("none")] = None
    task: str = "LiftBox"
    region: str = DEFAULT_REGION
    axes: tuple[str, ...] = _AXES
    perceptions: Annotated[tuple[str, ...] | None, default("none")] = None
    num_episodes: int = 50
    num_workers: int = 1
    results: Path = Path("results")
    figure: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Measure, then draw; the last line on stdout is the last result, or the figure's path.

    Raises:
        UnknownNameError: No such task, region, axis or perception.
        PolicyError: The policy does not fit.
    """
    from gym_demohlm.errors import UnknownNameError
    from gym_demohlm.perception.settings import PerceptionSettings
    from lerobot_demohlm.benchmarks.perception_curves import AXES, conditions, draw, measure, measured
    from lerobot_demohlm.reproducibility.results import append_result

    for axis in options.axes:
        if axis not in AXES:
            raise UnknownNameError("axis", axis, AXES)
    chosen = [*conditions(options.axes), *map(PerceptionSettings.read, options.perceptions or ())]
    lines = options.results / "perception_curves.jsonl"
    if options.policy is not None:
        import torch

        from lerobot_demohlm.evaluation.loaded_policy import load_policy

        torch.set_num_threads(1)
        loaded = load_policy(options.policy, options.task)
        command = spelled("benchmark perception", options, leave_out=("policy", "figure", "num_workers"))
        there = measured(lines, loaded, options.task, options.region, options.num_episodes)
        missing = [perception for perception in chosen if str(perception) not in there]
        for line in measure(
            loaded, options.task, options.region, missing, options.num_episodes, num_workers=options.num_workers
        ):
            print_json(append_result(lines, command, line))
    if options.figure is not None:
        draw(lines, options.figure)
        print(options.figure)
