"""Tasks, worlds and ways to replay -> how often generation succeeds with less feedback than it has: lines.

A line is one way of replaying one demonstration. All of a task start at the same places. Lines that are there already
are not measured again. Some ways lack one remedy against worlds that vary; the plain world, where none is at work, has
no lines of those.
"""

import math
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
from lerobot_demohlm.generation.locomotion import LocomotionSettings
from lerobot_demohlm.generation.open_replay import open_replay, without_symmetry
from lerobot_demohlm.generation.stages import GripSettings, Settings
from lerobot_demohlm.reproducibility.results import append_result

COMMAND = "demohlm benchmark feedback"
SEED = 972_000  # of the attempts' starts; not one that datasets, trials or other probes use


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A way to replay.

    Attributes:
        settings: Function from a variation's name to the settings of attempts.
        symmetric: Whether an object may be taken from any side that looks the same.
        in_plain: Whether it is another way in the plain world, too.
    """

    settings: Callable[[str], Settings]
    symmetric: bool = True
    in_plain: bool = True


def _ours(variation: str) -> Settings:
    return Settings(variation=replace(PLAIN, variation=variation))


def _noisy(variation: str) -> Settings:
    return Settings(variation=DataVariation(variation=variation))


def _open(variation: str) -> Settings:
    return open_replay(_ours(variation))


def _without(**changed: Any) -> Replay:  # noqa: ANN401
    """Return our way with other ``AdaptationSettings``, which count in worlds that vary."""

    def settings(variation: str) -> Settings:
        ours = _ours(variation)
        return replace(ours, adaptation=replace(ours.adaptation, **changed))

    return Replay(settings=settings, in_plain=False)


def _unsteered(variation: str) -> Settings:
    ours = _ours(variation)
    return replace(ours, playback=replace(ours.playback, steering_gain=0.0))


REPLAYS: Mapping[str, Replay] = MappingProxyType(
    {
        "ours": Replay(settings=_ours),
        "ours, DART noise": Replay(settings=_noisy),
        "ours, no symmetry": Replay(settings=_ours, symmetric=False),
        "open": Replay(settings=_open),
        "open, no symmetry": Replay(settings=_open, symmetric=False),
        "ours, no steering": Replay(settings=_unsteered),
        "ours, one try": _without(retries=0),
        "ours, no squeeze": _without(squeeze=0.0),
        "ours, light grip": _without(grip_n=GripSettings.grip_n),
        "ours, no step back": _without(leave_m=math.inf, holding_leave_m=math.inf),
        "ours, drift unseen": _without(drift_gain=0.0),
        "ours, straight legs": _without(highest_m=math.inf),
        "ours, fewer walks": _without(max_walks=LocomotionSettings.max_walks, accept_m=LocomotionSettings.accept_m),
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
        replays: Of ``REPLAYS``; those that change nothing in the plain world are left out there.
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
                if variation == PLAIN.variation and not REPLAYS[name].in_plain:
                    continue
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
