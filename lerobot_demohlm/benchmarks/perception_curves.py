"""A policy -> its success against what is wrong with its eyes, one error at a time, and the curves as a figure."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import get_task
from lerobot_demohlm.checks import portability
from lerobot_demohlm.evaluation.evaluate import FIRST_SEED, SUCCESSES, summarize
from lerobot_demohlm.evaluation.loaded_policy import LoadedPolicy
from lerobot_demohlm.evaluation.rollouts import Setting, rollouts
from lerobot_demohlm.experiments.success_curves import Panel, draw_panels

AXES: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "bias_mm": ("exact", (5.0, 10.0, 20.0, 30.0)),
    "latency_s": ("exact", (0.1, 0.2, 0.4)),
    "dropout": ("exact", (0.25, 0.5, 0.75)),
    "camera_error": ("rgbd", (0.5, 1.0, 2.0)),
    "mesh_scale": ("rgbd", (0.98, 1.02)),
}
"""What is varied: an option of a perception, the source that it is added to, and its values."""
PLAIN = {"mesh_scale": 1.0}
"""Values at which an axis changes nothing; 0 for the others."""
LABELS = {
    "bias_mm": "bias of an episode [mm]",
    "latency_s": "latency [s]",
    "dropout": "share of lost frames",
    "camera_error": "camera off by [degrees, and 5 mm each]",
    "mesh_scale": "known size of the mesh",
}


def conditions(axes: Sequence[str]) -> Iterator[PerceptionSettings]:
    """Yield what is evaluated for some axes: each source as it is, once, and then each value."""
    for source in dict.fromkeys(AXES[axis][0] for axis in axes):
        yield PerceptionSettings(source=source)
    for axis in axes:
        source, values = AXES[axis]
        for value in values:
            yield PerceptionSettings(source=source, **{axis: value})  # pyright: ignore[reportArgumentType]


def measure(
    loaded: LoadedPolicy,
    task: str,
    region: str,
    perceptions: Sequence[PerceptionSettings],
    num_episodes: int,
    seed: int = FIRST_SEED,
    num_workers: int = 1,
) -> Iterator[dict[str, Any]]:
    """Yield a line a perception, from the same starts.

    Args:
        loaded: The policy.
        task: Name of the task.
        region: Initial region.
        perceptions: What is evaluated.
        num_episodes: Rollouts of each.
        seed: Of the first rollout.
        num_workers: Processes.
    """
    for perception in perceptions:
        setting = Setting(task=task, region=region, num_workers=num_workers, perception=str(perception))
        found = list(rollouts(loaded, setting, range(seed, seed + num_episodes)))
        summary = summarize(found)
        yield {
            "task": get_task(task).name,
            "stamp": portability.stamp(get_task(task)),
            "region": region,
            "policy": loaded.kind,
            "policy_hash": loaded.hash[:12],
            "num_train_episodes": loaded.num_train_episodes,
            "perception": str(perception),
            "seed": seed,
            "episodes": summary["episodes"],
            **{name: summary[name] for name in SUCCESSES},
        }


def measured(lines: Path, loaded: LoadedPolicy, task: str, region: str, num_episodes: int) -> set[str]:
    """Return the perceptions that a file of ``measure``'s lines has for a policy with as many rollouts."""
    if not lines.exists():
        return set()
    of = {"task": get_task(task).name, "stamp": portability.stamp(get_task(task))}
    wanted = {**of, "region": region, "policy_hash": loaded.hash[:12], "episodes": num_episodes}
    return {line["perception"] for line in jsonl.read(lines) if wanted.items() <= line.items()}


def draw(lines: Path, figure: Path) -> None:
    """Draw the curves in a file of ``measure``'s lines, with 95 % intervals, an axis a panel.

    Of several policies of one kind, task and region, the one that was measured last is drawn.

    Args:
        lines: The file.
        figure: Image file; its folder is made.

    Raises:
        DatasetError: There is no such file, it is damaged, or no policy was measured at two values of an axis.
    """
    found: dict[tuple[str, str, str, str], dict[str, Any]] = {}
    drawn: dict[tuple[str, str, str], str] = {}
    for line in jsonl.read(lines):
        if "success_strict" in line:
            kind = line["task"], line["policy"], line["region"]
            if drawn.setdefault(kind, line["policy_hash"]) != line["policy_hash"]:
                drawn[kind] = line["policy_hash"]
                found = {key: other for key, other in found.items() if key[:3] != kind}
            found[*kind, line["perception"]] = line
    panels = []
    for axis, (source, values) in AXES.items():
        curves = {}
        for task, policy, region in sorted({key[:3] for key in found}):
            points = []
            for value in sorted({PLAIN.get(axis, 0.0), *values}):
                perception = PerceptionSettings(source=source, **{axis: value})  # pyright: ignore[reportArgumentType]
                line = found.get((task, policy, region, str(perception)))
                if line is not None:
                    points.append((value, line["success_strict"]["rate"], *line["success_strict"]["interval"]))
            curves[f"{task} {region}, {policy}"] = points
        if any(len(points) > 1 for points in curves.values()):
            panels.append(Panel(title=f"on {source} poses", label=LABELS[axis], curves=curves))
    if not panels:
        raise DatasetError(f"no curve in {lines}", "a policy at two values of an axis", "measure with --policy")
    draw_panels(panels, "strict success", figure, panel_size=(3.4, 3.2))
