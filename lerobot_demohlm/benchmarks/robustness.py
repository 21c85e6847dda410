"""A policy -> its success in worlds that vary by one group of factors, at three strengths: a line each."""

from collections.abc import Iterator, Sequence
from typing import Any

from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, summarize
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy
from lerobot_demohlm.evaluation.rollouts import Setting, rollouts
from lerobot_demohlm.experiments.plan import STRENGTHS, graded
from lerobot_demohlm.experiments.robustness import SUCCESS


def measure(
    loaded: LoadedPolicy,
    task: str,
    region: str,
    groups: Sequence[str],
    num_episodes: int,
    num_workers: int = 1,
) -> Iterator[dict[str, Any]]:
    """Yield a line for the plain world, and one for each group and strength, from the same starts.

    Args:
        loaded: The policy.
        task: Name of the task.
        region: Initial region.
        groups: Names of the groups.
        num_episodes: Rollouts of each.
        num_workers: Processes.

    Raises:
        DatasetError: ``num_episodes`` is less than 1.
        UnknownNameError: No such group.
    """
    if num_episodes < 1:
        raise DatasetError(f"num_episodes={num_episodes}", "1 or more", "correct --num-episodes")
    for group in groups:
        if group not in GROUPS:
            raise UnknownNameError("group", group, GROUPS)
    cells = [(None, 0.0), *((group, strength) for group in groups for strength in STRENGTHS)]
    for group, strength in cells:
        setting = Setting(task=task, region=region, variation=graded(group, strength), num_workers=num_workers)
        found = list(rollouts(loaded, setting, range(FIRST_SEED, FIRST_SEED + num_episodes)))
        summary = summarize(found)
        yield {
            "task": get_task(task).name,
            "region": region,
            "policy": loaded.kind,
            "policy_hash": loaded.hash[:12],
            "num_train_episodes": loaded.num_train_episodes,
            "group": group or "none",
            "strength": strength,
            "seed": FIRST_SEED,
            **{name: summary[name] for name in ("episodes", SUCCESS, "success_held", "outcomes")},
        }
