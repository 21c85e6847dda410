"""Tasks, worlds and ways to replay -> how often generation succeeds with less feedback than it has: lines.

A line is one way of replaying one demonstration. All of a task start at the same places. Lines that are there already
are not measured again.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.task import DEFAULT_REGION, Task
from gym_demohlm.variation import get_variation
from lerobot_demohlm.benchmarks.tally import Tally, stamps, tally
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.generation.open_replay import open_replay, without_symmetry
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reproducibility.results import append_result

COMMAND = "demohlm benchmark feedback"
SEED = 972_000  # of the attempts' starts; not one that datasets, trials or other probes use


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A way to replay.

    Attributes:
        settings: Function from a variation's name to the settings of attempts.
        symmetric: Whether an object may be taken from any side that looks the same.
    """

    settings: Callable[[str], Settings]
    symmetric: bool = True


def _ours(variation: str) -> Settings:
    return Settings(variation=replace(PLAIN, variation=variation))


def _noisy(variation: str) -> Settings:
    return Settings(variation=DataVariation(variation=variation))


def _open(variation: str) -> Settings:
    return open_replay(_ours(variation))


REPLAYS: Mapping[str, Replay] = MappingProxyType(
    {
        "ours": Replay(settings=_ours),
        "ours, DART noise": Replay(settings=_noisy),
        "ours, no symmetry": Replay(settings=_ours, symmetric=False),
        "open": Replay(settings=_open),
        "open, no symmetry": Replay(settings=_open, symmetric=False),
    }
)
"""By the name in results. Only the second has noise in its commands, as ``demohlm generate`` has by default."""


@dataclass(frozen=True, kw_only=True)
class FeedbackLine(Tally):
    """What became of the attempts of one task, replayed in one way.

    Attributes:
        replay: One of ``REPLAYS``.
    """

    replay: str


def measure(
    tasks: Sequence[Task],
    variations: Sequence[str],
    replays: Sequence[str],
    attempts: int,
    path: Path,
    region: str = DEFAULT_REGION,
) -> Iterator[FeedbackLine]:
    """Measure what is not in a file yet, append it there, and yield every line asked for.

    Args:
        tasks: The tasks.
        variations: Names of the variations.
        replays: Of ``REPLAYS``.
        attempts: Of each line.
        path: The file of lines.
        region: Where attempts start.

    Raises:
        DatasetError: ``attempts`` is less than 1.
        UnknownNameError: No such variation, replay or region.
    """
    if attempts < 1:
        raise DatasetError(f"attempts={attempts}", "1 or more", "correct --num-attempts")
    for name in replays:
        if name not in REPLAYS:
            raise UnknownNameError("replay", name, REPLAYS)
    for name in variations:
        get_variation(name)
    known = {(*line.made_of, line.replay): line for line in jsonl.read_as(FeedbackLine, path)} if path.exists() else {}
    for task in tasks:
        for variation in variations:
            stamp, worlds = stamps(task, variation, region)
            for name in replays:
                line = known.get((task.name, variation, region, attempts, stamp, worlds, name))
                if line is None:
                    values = _measure(task, variation, name, attempts, region) | {"stamp": stamp, "worlds": worlds}
                    call = f'{COMMAND} --tasks {task.name} --variations {variation} --replays "{name}"'
                    append_result(path, f"{call} --num-attempts {attempts} --region {region}", values)
                    line = jsonl.parse(FeedbackLine, values, str(path))
                yield line


def _measure(task: Task, variation: str, name: str, count: int, region: str) -> dict[str, Any]:
    replay = REPLAYS[name]
    taken = task.at(region) if replay.symmetric else without_symmetry(task.at(region))
    return {"replay": name, **tally(taken, replay.settings(variation), region, SEED, count)}
