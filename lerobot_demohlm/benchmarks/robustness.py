"""A policy -> its success in worlds that vary by one group of factors, at three strengths: lines, a table, a figure."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.benchmarks.success_curves import Panel, draw_panels
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, summarize
from lerobot_demohlm.evaluation.rollouts import LoadedPolicy, Setting, rollouts
from lerobot_demohlm.experiments.tables import markdown

PRESET = "hard"
STRENGTHS = (0.5, 1.0, 1.5)
SUCCESS = "success_strict"


def variation(group: str | None, strength: float) -> str:
    """Return the name of the variation of one group; without a group, of the plain world."""
    return "none" if group is None else f"{PRESET}@{strength:g}:{group}"


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
        UnknownNameError: No such group, or one without factors.
    """
    if num_episodes < 1:
        raise DatasetError(f"num_episodes={num_episodes}", "1 or more", "correct --num-episodes")
    for group in groups:
        if group not in GROUPS:
            raise UnknownNameError("group", group, GROUPS)
    cells = [(None, 0.0), *((group, strength) for group in groups for strength in STRENGTHS)]
    for group, strength in cells:
        setting = Setting(task=task, region=region, variation=variation(group, strength), num_workers=num_workers)
        found = list(rollouts(loaded, setting, range(FIRST_SEED, FIRST_SEED + num_episodes)))
        summary = summarize(found)
        yield {
            "task": task,
            "region": region,
            "policy": loaded.kind,
            "policy_hash": loaded.hash[:12],
            "num_train_episodes": loaded.num_train_episodes,
            "group": group or "none",
            "strength": strength,
            "seed": FIRST_SEED,
            **{name: summary[name] for name in ("episodes", SUCCESS, "success_held", "outcomes")},
        }


def table(lines: Path) -> str:
    """Return a Markdown table of policies against groups: strict success [%] at each strength.

    Args:
        lines: File of ``measure``'s lines.

    Raises:
        DatasetError: There is no such file, or it is damaged.
    """
    found = _read(lines)
    header = ["task", "policy", "plain", *(f"{group}, x {' / '.join(f'{s:g}' for s in STRENGTHS)}" for group in GROUPS)]
    rows = []
    for task, region, policy in dict.fromkeys(key[:3] for key in found):

        def rate(group: str, strength: float, of: tuple[str, str, str] = (task, region, policy)) -> str:
            line = found.get((*of, group, strength))
            return "-" if line is None else f"{100 * line[SUCCESS]['rate']:.0f}"

        cells = [" / ".join(rate(group, strength) for strength in STRENGTHS) for group in GROUPS]
        rows.append([f"{task} {region}", policy, rate("none", 0.0), *cells])
    return f"**Strict success [%] in worlds that vary by one group of `{PRESET}`**\n\n" + markdown(header, rows)


def draw(lines: Path, figure: Path) -> None:
    """Draw strict success against strength, a picture a group, with 95 % intervals.

    Args:
        lines: File of ``measure``'s lines.
        figure: Image file; its folder is made.

    Raises:
        DatasetError: There is no such file, or it is damaged.
    """
    found = _read(lines)
    panels = []
    for group in GROUPS:
        curves = {}
        for task, region, policy in dict.fromkeys(key[:3] for key in found):
            cells = [found.get((task, region, policy, "none", 0.0))]
            cells += [found.get((task, region, policy, group, strength)) for strength in STRENGTHS]
            points = [(c["strength"], c[SUCCESS]["rate"], *c[SUCCESS]["interval"]) for c in cells if c is not None]
            curves[f"{task} {region}, {policy}"] = points
        panels.append(Panel(title=group, label=f"strength of {PRESET}", curves=curves))
    draw_panels(panels, "strict success", figure, panel_size=(2.6, 3.0))


def _read(lines: Path) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Return the last line of each task, region, policy, group and strength."""
    kept = [line for line in jsonl.read(lines) if "group" in line and SUCCESS in line]
    return {tuple(line[key] for key in ("task", "region", "policy", "group", "strength")): line for line in kept}
