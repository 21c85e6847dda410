"""Tasks and variations -> how often generation succeeds in worlds that vary, and what fails: lines.

A line stands for the attempts of one task under one variation. The attempts of a task start at the same places under
all of them, so columns differ by the worlds alone. Lines that are there already are not measured again.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION, Task
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.benchmarks.tally import Tally, stamps, tally
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility.results import append_result

SEED = 970_000  # of the attempts' starts; not one that datasets, trials or other probes use
PROBES = ("none", "real", *(f"real:{group}" for group in GROUPS))


@dataclass(frozen=True, kw_only=True)
class Probe(Tally):
    """What became of the attempts of one task under one variation."""


def measure(
    tasks: Sequence[Task],
    variations: Iterable[str],
    attempts: int,
    path: Path,
    region: str = DEFAULT_REGION,
) -> Iterator[Probe]:
    """Measure what is not in a file yet, append it there, and yield every probe asked for.

    Args:
        tasks: The tasks.
        variations: Names of the variations.
        attempts: Of each probe.
        path: The file of lines.
        region: Where attempts start.

    Raises:
        DatasetError: ``attempts`` is less than 1.
        UnknownNameError: No such variation or region.
    """
    if attempts < 1:
        raise DatasetError(f"attempts={attempts}", "1 or more", "correct --num-attempts")
    known = {probe.made_of: probe for probe in jsonl.read_as(Probe, path)} if path.exists() else {}
    for variation in variations:
        for task in tasks:
            stamp, worlds = stamps(task, variation, region)
            probe = known.get((task.name, variation, region, attempts, stamp, worlds))
            if probe is None:
                settings = Settings(variation=replace(PLAIN, variation=variation))
                values = tally(task, settings, region, SEED, attempts) | {"stamp": stamp, "worlds": worlds}
                call = f"demohlm benchmark variation --tasks {task.name} --variations {variation}"
                append_result(path, f"{call} --num-attempts {attempts} --region {region}", values)
                probe = jsonl.parse(Probe, values, str(path))
            yield probe
