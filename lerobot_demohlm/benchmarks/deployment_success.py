"""A policy and seeded starts -> its successes over the robot's protocol and in one process: lines, a table.

Both judge alike: success is held for a second. Both have the same starts; over the protocol the robot first stands up
in its gantry, so that it may have moved a little before its policy begins.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import jsonl
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks.deployment import RobotProcess, machine, robot_and_folder, settings_for, stand_and_run
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy, load_policy
from lerobot_demohlm.evaluation.rollouts import Setting, rollouts
from lerobot_demohlm.hardware import recorder
from lerobot_demohlm.hardware.deployment import Deployment
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.records import Mode

TOGETHER = 10  # starts in one session of robot and deployment, and in one line
DOMAIN = 182
EPISODE_S = 60.0
_COUNTED = (
    "states",
    "late",
    "executed",
    "gaps_over_40_ms",
    "gap_p99_ms",
    "gap_max_ms",
    "violations",
    "worst",
    "bad_crc",
)


@dataclass(frozen=True, kw_only=True)
class SuccessLine:
    """Some starts of one policy over the protocol and in one process; a line has ages and gaps beside these.

    Attributes:
        task: Name of the task.
        region: Of the starts.
        source: Of poses.
        policy: The first digits of the policy's hash.
        first_seed: Of the first start; each further one has the next seed.
        episodes: Starts.
        successes: Of these, over the protocol.
        in_process: Of these, in one process.
    """

    task: str
    region: str
    source: str
    policy: str
    first_seed: int
    episodes: int
    successes: int
    in_process: int

    @property
    def key(self) -> tuple[Any, ...]:
        """What was measured."""
        return (self.task, self.region, self.source, self.policy, self.first_seed, self.episodes)


def read(path: Path) -> list[SuccessLine]:
    """Return the lines about success of a file, of several measurements of the same the last one."""
    found = [line for line in jsonl.read(path) if line.get("part") == "success" and "in_process" in line]
    lines = [jsonl.parse(SuccessLine, line, str(path)) for line in found]
    return list({line.key: line for line in lines}.values())


def measure_success(
    task: str,
    policy: Path,
    region: str,
    seeds: Sequence[int],
    source: str,
    domain: int = DOMAIN,
    known: Sequence[SuccessLine] = (),
) -> Iterator[dict[str, Any]]:
    """Run a policy from seeded starts over the protocol and in one process; yields a line for ``TOGETHER`` at a time.

    Args:
        task: Name of the task.
        policy: A ``pretrained_model`` directory.
        region: Of the starts.
        seeds: One an episode, each one more than the one before.
        source: Of poses.
        domain: Of DDS; measurements at the same time need one each.
        known: Lines that need not be measured again.
    """
    name, keys = get_task(task).name, {line.key for line in known}
    loaded = load_policy(policy, name)
    for first in range(0, len(seeds), TOGETHER):
        some = seeds[first : first + TOGETHER]
        facts = {"task": name, "region": region, "source": source, "policy": loaded.hash[:12], "first_seed": some[0]}
        if (*facts.values(), len(some)) not in keys:
            yield {"part": "success", **facts, "episodes": len(some), **_in_process(loaded, name, region, some, source),
                   **_over_the_protocol(name, policy, region, some, source, domain), **machine()}  # fmt: skip


def _in_process(loaded: LoadedPolicy, task: str, region: str, seeds: Sequence[int], source: str) -> dict[str, Any]:
    found = list(rollouts(loaded, Setting(task=task, region=region, perception=source), seeds))
    return {
        "in_process": sum(rollout.success_held for rollout in found),
        "in_process_outcomes": [rollout.outcome for rollout in found],
    }


def _over_the_protocol(
    task: str, policy: Path, region: str, seeds: Sequence[int], source: str, domain: int
) -> dict[str, Any]:
    outcomes: list[dict[str, Any]] = []
    with robot_and_folder(task, domain, ["--region", region, "--seed", str(seeds[0])]) as (robot, folder):
        settings = settings_for(task, policy, robot, domain, folder / "record", source)
        with Deployment(settings) as deployment:
            for _ in seeds:
                _stand_and_run(deployment, robot)
                found = robot.wait_for("episode", EPISODE_S)
                outcomes.append(found | {"mode": deployment.mode.name, "reason": deployment.reason})
                deployment.request(Mode.DAMP)
                robot.wait_for("hangs", 20.0)
        rows = recorder.read(folder / "record")
        counted = robot.end()
    running = np.asarray(rows["control.mode"]) == Mode.RUN
    return {
        "successes": sum(entry["outcome"] == "success" for entry in outcomes),
        "outcomes": [entry["outcome"] for entry in outcomes],
        "held": [entry["reason"] for entry in outcomes if entry["mode"] != "RUN"],
        **_ages(rows, running),
        **{name: counted.get(name) for name in _COUNTED},
    }


def _stand_and_run(deployment: Deployment, robot: RobotProcess) -> None:
    """Have a hanging robot stand and run; one that damps in between falls, and its start is one that fails."""
    try:
        stand_and_run(deployment, robot)
    except RobotError:
        if deployment.mode != Mode.DAMP:
            raise


def _ages(rows: Any, running: np.ndarray) -> dict[str, float]:  # noqa: ANN401
    found = {}
    for name in ("state", "policy", "pose"):
        values = 1e3 * np.asarray(rows[f"control.{name}_age_s"], dtype=np.float64)[running]
        values = values[np.isfinite(values)]
        if len(values):
            found |= {f"{name}_age_p50_ms": float(np.percentile(values, 50))}
            found |= {f"{name}_age_p99_ms": float(np.percentile(values, 99))}
    return found


def table(lines: Sequence[SuccessLine]) -> str:
    """Return lines as a Markdown table: a row for each task, region, source and policy, in the order they came.

    Behind a share of successes stands its 95 % interval (Wilson).
    """
    rows = ["| task | region | poses | starts | over DDS [%] | in one process [%] |", "|" + "---|" * 6]
    kinds: dict[tuple[str, ...], list[SuccessLine]] = {}
    for line in lines:
        kinds.setdefault((line.task, line.region, line.source, line.policy), []).append(line)
    for (task, region, source, _), own in kinds.items():
        count = sum(line.episodes for line in own)
        shares = (_share(sum(getattr(line, name) for line in own), count) for name in ("successes", "in_process"))
        rows.append(f"| {task} | {region} | `{source}` | {count} | {' | '.join(shares)} |")
    return "\n".join(rows)


def _share(successes: int, count: int) -> str:
    low, high = wilson(successes, count)
    return f"{100 * successes / count:.0f} ({100 * low:.0f} to {100 * high:.0f})"
