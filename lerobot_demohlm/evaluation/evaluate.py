"""Rollouts of a policy -> one JSON line an episode, resumed where they were killed, and rates with Wilson intervals."""

import argparse
import json
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError, PolicyError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation.judge import OUTCOMES
from lerobot_demohlm.datasets.facts import count_outcomes
from lerobot_demohlm.evaluation.rollouts import NUM_WORLDS, LoadedPolicy, OnStep, Setting, load_policy, roll_batches

FIRST_SEED = 1_000_000
"""Rollouts draw their starts from this seed on. Generation draws from (seed, attempt) pairs: no start is shared."""
SUCCESSES = ("success_held", "success_end", "success_ever")


def evaluate(
    loaded: LoadedPolicy,
    setting: Setting,
    seeds: Sequence[int],
    output: Path,
    *,
    deadline: float = math.inf,
    on_step: OnStep | None = None,
) -> list[dict[str, Any]]:
    """Roll out and append one JSON line an episode to a file; a call that was killed is resumed by the same call.

    A batch is made again whole where one of its lines is missing, so that a policy that draws random numbers gives the
    lines that it would have given undisturbed.

    Args:
        loaded: The policy.
        setting: Task, region and how many at a time.
        seeds: One an episode.
        output: The file; made where it does not exist.
        deadline: Begin no batch after this time (``time.monotonic``) [s].
        on_step: See ``OnStep``; with one worker only.

    Returns:
        The records in the file of these seeds, in their order; fewer where the deadline came first.

    Raises:
        DatasetError: The file holds rollouts of something else.
    """
    from tqdm import tqdm

    header = {
        "task": get_task(setting.task).name,
        "region": setting.region,
        "policy": loaded.kind,
        "policy_hash": loaded.hash,
    }
    setting = setting.limited(len(seeds))  # of all seeds, so that a resumed batch is as wide as it was
    found = {record["seed"]: record for record in resumed_records(output, header)}
    pending = [batch for batch in setting.batches(seeds) if not found.keys() >= set(batch)]
    with tqdm(total=len(seeds), initial=sum(seed in found for seed in seeds), desc="rollouts", unit="episode") as bar:
        for records in _until(deadline, roll_batches(loaded, setting, pending, on_step=on_step)):
            new = [record for record in records if record["seed"] not in found]
            append_records(output, new)
            found |= {record["seed"]: record for record in new}
            bar.update(len(new))
    return [found[seed] for seed in seeds if seed in found]


def _until(deadline: float, batches: Iterator[list[dict[str, Any]]]) -> Iterator[list[dict[str, Any]]]:
    """Yield batches until the deadline has passed."""
    while time.monotonic() < deadline:
        records = next(batches, None)
        if records is None:
            return
        yield records


def wilson(successes: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the Wilson score interval of a rate, 95 % by default.

    Args:
        successes: How many.
        count: Of how many, at least 1.
        z: Quantile of the normal distribution.
    """
    if not 0 <= successes <= count or count < 1:
        raise ValueError(f"got {successes} successes of {count}; expected 0 to {count}, of 1 or more; count again")
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))  # min and max: rounding at 0 and 1


def summarize(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the success rates of rollouts with their intervals, and the count of each outcome."""
    content: dict[str, Any] = {"episodes": len(records)}
    for name in SUCCESSES:
        successes = sum(record[name] for record in records)
        low, high = wilson(successes, len(records))
        content[name] = {"rate": round(successes / len(records), 4), "interval": [round(low, 4), round(high, 4)]}
    return content | {"outcomes": count_outcomes(records)}


def append_records(path: Path, records: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Append records as they come, one JSON line each, and return them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    written = []
    with path.open("a") as file:
        for record in records:
            file.write(json.dumps(record) + "\n")
            file.flush()
            written.append(record)
    return written


def resumed_records(path: Path, header: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the records that a killed evaluation left, none where there is no file; a torn last line is cut off.

    Args:
        path: The file.
        header: What every record must say, by key.

    Raises:
        DatasetError: A record says something else, or the file holds no records.
    """
    if not path.exists():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        with path.open("r+b") as file:
            file.truncate(len(whole))
    if not whole:
        return []
    records = read_records(path)
    for record in records:
        for key, value in header.items():
            if record.get(key) != value:
                raise DatasetError(
                    f"{path} with rollouts of {key}={record.get(key)}", f"{key}={value}", "choose another --output"
                )
    return records


def read_records(path: Path) -> list[dict[str, Any]]:
    """Return the records of a file of ``demohlm evaluate``.

    Raises:
        DatasetError: There is no such file, or it holds something else.
    """
    try:
        records = [json.loads(line) for line in Path(path).read_text().splitlines()]
        valid = bool(records) and all(record["outcome"] in OUTCOMES for record in records)
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} ({error})", "a file of `demohlm evaluate`", "check the path") from error
    if not valid:
        raise DatasetError(f"{path} without rollouts", "a file of `demohlm evaluate`", "check the path")
    return records


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm evaluate``."""
    parser.add_argument("--policy", type=Path, required=True, help="a pretrained_model directory of lerobot-train")
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument("--region", default="R3", help="initial region, R1 to R3 (default: %(default)s)")
    parser.add_argument("--num-episodes", type=int, default=50, help="rollouts (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first rollout (default: %(default)s)")
    parser.add_argument("--num-worlds", type=int, default=NUM_WORLDS, help="rollouts at a time (default: %(default)s)")
    parser.add_argument("--num-threads", type=int, default=1, help="threads of the physics (default: %(default)s)")
    parser.add_argument("--num-workers", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--output", type=Path, help="file for the JSON lines; resumed where it exists (default: none)")
    parser.add_argument("--device", default="cpu", help="where the policy runs (default: %(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm evaluate``; the last line on stdout is the summary as JSON.

    Raises:
        UnknownNameError: No such task or region.
        PolicyError: The policy does not fit, or a count is not positive.
        DatasetError: The output holds rollouts of something else.
    """
    import tempfile

    import torch

    if arguments.num_episodes < 1 or arguments.seed < 0:
        raise PolicyError(
            f"num_episodes={arguments.num_episodes}, seed={arguments.seed}",
            "at least one episode and a seed of 0 or more",
            "correct them",
        )
    setting = Setting(
        **{name: getattr(arguments, name) for name in ("task", "region", "num_worlds", "num_threads", "num_workers")}
    )
    torch.set_num_threads(1)
    loaded = load_policy(arguments.policy, arguments.task, arguments.device)
    seeds = range(arguments.seed, arguments.seed + arguments.num_episodes)
    with tempfile.TemporaryDirectory() as scratch:
        records = evaluate(loaded, setting, seeds, arguments.output or Path(scratch) / "rollouts.jsonl")
    print(json.dumps({"task": get_task(arguments.task).name, "region": arguments.region, **summarize(records)}))
