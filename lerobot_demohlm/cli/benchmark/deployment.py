"""``demohlm benchmark deployment``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from gym_demohlm import jsonl
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark deployment``.

    Attributes:
        part: Rates of the link; success from seeded starts, over DDS and in one process; or answers to seeded faults.
        policy: A pretrained_model directory, for success and faults.
        task: Name of the task.
        region: Of the starts, for success.
        pose_source: Where objects are, for success.
        seed: Of the first start or fault.
        num_runs: Starts or faults.
        seconds: How long the link is measured [s].
        domain: Of DDS, for success; measurements at the same time need one each.
        append: Append results to this file of JSON lines; starts and faults that it has already are left out.
    """

    part: Literal["link", "success", "faults"] = "link"
    policy: Annotated[Path | None, default("none")] = None
    task: str = "LiftBox"
    region: str = "R1"
    pose_source: Literal["exact", "rgbd"] = "exact"
    seed: int = 1_000_000
    num_runs: int = 10
    seconds: float = 60.0
    domain: int = 182
    append: Annotated[Path | None, default("none")] = None


def run(options: Options) -> None:
    """Measure; each line on stdout is a result as JSON.

    Raises:
        RobotError: No policy where one is needed, or a simulated robot that does not do what it is told.
    """
    from lerobot_demohlm.benchmarks import deployment, deployment_faults, deployment_success
    from lerobot_demohlm.hardware.errors import RobotError
    from lerobot_demohlm.reproducibility.results import append_result

    call = f"demohlm benchmark deployment --part {options.part}"
    seeds = range(options.seed, options.seed + options.num_runs)
    if options.part == "link":
        call += f" --seconds {options.seconds:g}"
        results = iter([deployment.measure_link(options.seconds)])
    elif options.policy is None:
        raise RobotError(f"--part {options.part} without a policy", "a checkpoint", "give --policy")
    elif options.part == "success":
        call += f" --task {options.task} --region {options.region} --pose-source {options.pose_source}"
        call += f" --seed {options.seed} --num-runs {options.num_runs}"
        known = deployment_success.read(options.append) if options.append and options.append.is_file() else []
        results = deployment_success.measure_success(
            options.task, options.policy, options.region, seeds, options.pose_source, options.domain, known
        )
    else:
        call += f" --task {options.task} --seed {options.seed} --num-runs {options.num_runs}"
        done = deployment_faults.measured_seeds(_lines(options.append), options.task, options.policy)
        results = deployment_faults.measure_faults(
            options.task, options.policy, [seed for seed in seeds if seed not in done]
        )
    for result in results:
        print_json(result if options.append is None else append_result(options.append, call, result))


def _lines(path: Path | None) -> list[dict[str, Any]]:
    """Return the results that a file holds already."""
    return jsonl.read(path) if path is not None and path.is_file() else []
