"""All attempts of a run, failed ones included -> one HTML page: reasons, rates, what success depended on, times."""

import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gym_demohlm.task import Region, Task
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.generation.stages import STAGES
from lerobot_demohlm.reports.explain.figures import BAD, GOOD, OUTCOME_COLOURS, Axis, histogram, rate_bars, rate_map
from lerobot_demohlm.reports.explain.pages import render
from lerobot_demohlm.reports.influences import START_NAMES, influences, section

LISTED = 60  # failed attempts, at most
EXTREMES = 5  # shortest and longest successes
BINS = 8


def run_page(root: Path, facts: Mapping[str, Any], records: Sequence[Mapping[str, Any]], task: Task) -> str:
    """Return the page.

    Args:
        root: Of the dataset, for the commands.
        facts: Its ``meta/demohlm.json``.
        records: All attempts.
        task: Of the run.
    """
    success = np.array([record["outcome"] == "success" for record in records])
    by_length = sorted((record for record in records if record["outcome"] == "success"), key=lambda r: r["length_s"])
    failed = [record for record in records if record["outcome"] != "success"]
    region = task.region(facts["region"]).widened(DataVariation.read(facts).start_spread)
    return render(
        "run.html.j2",
        title=f"{facts['task']}, {facts['region']}, seed {facts['seed']}: {len(records)} attempts",
        facts=facts,
        rate=float(success.mean()),
        interval=wilson(int(success.sum()), len(records)),
        successes=int(success.sum()),
        count=len(records),
        maps=maps(records, success, region),
        bars=bars(records, success, region),
        influences=section(influences([record["initial_state"] for record in records], success)),
        times=times(records, success),
        stage_times=stage_times(records),
        ends=ends(records),
        reasons=reasons(failed),
        stages=STAGES,
        outcome_colours={name: OUTCOME_COLOURS[name] for name in OUTCOME_COLOURS if facts["outcomes"].get(name)},
        extremes=[*by_length[:EXTREMES], *by_length[max(EXTREMES, len(by_length) - EXTREMES) :]],
        failed=failed[:LISTED],
        num_failed=len(failed),
        command=lambda attempt: command_line(root, attempt),
        percent=lambda share: f"{100 * share:.1f} %",
    )


def command_line(root: Path, attempt: int) -> str:
    """Return the command that explains one attempt."""
    return f"demohlm explain --root {shlex.quote(str(root))} --attempt {attempt} --output attempt_{attempt}.html"


def axes(records: Sequence[Mapping[str, Any]], region: Region) -> dict[str, Axis]:
    """Return the six numbers of the initial states, by their names in ``Region``."""
    states = np.array([[*r["initial_state"]["robot"], *r["initial_state"]["object"]] for r in records], dtype=float)
    keys = ("robot_x", "robot_y", "robot_yaw", "object_y", "object_z", "object_yaw")
    named = dict(zip(keys, (*START_NAMES["robot"], *START_NAMES["object"]), strict=True))
    found = {}
    for column, (key, name) in enumerate(named.items()):
        scale = 180.0 / math.pi if key.endswith("yaw") else 1.0
        low, high = (scale * end for end in getattr(region, key))
        found[key] = Axis(name=name, values=scale * states[:, column], low=low, high=high)
    return found


def maps(records: Sequence[Mapping[str, Any]], success: np.ndarray, region: Region) -> list[Markup]:
    """Return maps of success, with failed attempts in the colour of their outcome."""
    known = axes(records, region)
    dots = [
        (row, OUTCOME_COLOURS[record["outcome"]], f"attempt {record['attempt']}: {_ended(record)}")
        for row, record in enumerate(records)
        if record["outcome"] != "success"
    ]
    pairs = (("robot_x", "robot_y"), ("robot_yaw", "object_yaw"), ("object_y", "object_z"))
    return [
        rate_map(known[across], known[up], success, dots) for across, up in pairs if _wide(known[across], known[up])
    ]


def bars(records: Sequence[Mapping[str, Any]], success: np.ndarray, region: Region) -> list[Markup]:
    """Return success rates over each number of the initial state."""
    count = int(np.clip(len(records) // 10, 1, BINS))
    found = []
    for axis in axes(records, region).values():
        if _wide(axis):
            bins = axis.bins(count)
            numbers = [(int(success[bins == column].sum()), int((bins == column).sum())) for column in range(count)]
            found.append(rate_bars(axis, success, [wilson(good, n) if n else (0.0, 0.0) for good, n in numbers], count))
    return found


def _wide(*found: Axis) -> bool:
    return all(axis.high - axis.low > 1e-9 for axis in found)


def times(records: Sequence[Mapping[str, Any]], success: np.ndarray) -> list[Markup]:
    """Return histograms of the time spent in each stage, and in all."""
    columns = {stage.replace("_", " "): [r["stage_s"].get(stage, math.nan) for r in records] for stage in STAGES}
    columns["in all"] = [record["length_s"] for record in records]
    found = []
    for name, values in columns.items():
        seconds = np.array(values, dtype=float)
        groups = {"successes": (seconds[success], GOOD), "failures": (seconds[~success], BAD)}
        groups = {key: (part[np.isfinite(part)], colour) for key, (part, colour) in groups.items()}
        if any(len(part) for part, _ in groups.values()):
            found.append(histogram(f"{name} [s]", groups))
    return found


def stage_times(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, int, float, float, float]]:
    """Return (stage, attempts that reached it, mean, 5th and 95th percentile of its time [s])."""
    found = []
    for stage in STAGES:
        seconds = [record["stage_s"][stage] for record in records if stage in record["stage_s"]]
        if seconds:
            low, high = np.quantile(seconds, [0.05, 0.95])
            found.append((stage, len(seconds), float(np.mean(seconds)), float(low), float(high)))
    return found


def ends(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, dict[str, int], int]]:
    """Return (outcome, attempts by the stage in which they ended, in all)."""
    counts = Counter((record["outcome"], record["stage"]) for record in records)
    rows = []
    for outcome in OUTCOME_COLOURS:
        by_stage = {stage: counts[outcome, stage] for stage in STAGES}
        if sum(by_stage.values()):
            rows.append((outcome, by_stage, sum(by_stage.values())))
    return rows


def reasons(failed: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, int, list[int]]]:
    """Return (outcome, reason with its numbers left out, how often, first attempts), the most frequent first."""
    found: dict[tuple[str, str], list[int]] = {}
    for record in failed:
        general = re.sub(r"\d+(\.\d+)?(?= (?:N|m|deg|s)\b)", "…", record["reason"].split(" (")[0])
        found.setdefault((record["outcome"], general), []).append(record["attempt"])
    rows = [(outcome, reason, len(attempts), attempts[:8]) for (outcome, reason), attempts in found.items()]
    return sorted(rows, key=lambda row: -row[2])


def _ended(record: Mapping[str, Any]) -> str:
    return f"{record['outcome'].replace('_', ' ')} in {record['stage'].replace('_', ' ')}, {record['reason']}"
