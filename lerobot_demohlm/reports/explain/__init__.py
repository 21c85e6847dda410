"""A generation run, or one of its attempts -> an HTML page that explains it, with everything inside.

An attempt is made again for its page, so any can be explained, also a failed one that was not kept. ``--root`` is a
dataset, or the ``ROOT.partial`` of a run that is not finished, or that never succeeded.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from gym_demohlm.task import Task
from lerobot_demohlm.datasets import origin
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.datasets.facts import count_attempts
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.generation.run import made_so_far


def read_run(root: Path, episode: int | None = None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the facts of a run, as in ``meta/demohlm.json``, and its attempts.

    Args:
        root: Of its dataset, of its failed attempts, or of what it has done so far.
        episode: One whose run is wanted, where LeRobot has merged several.
    """
    begun = root / "run.json"
    if not begun.is_file():
        return origin.read_run(root, episode)
    records = made_so_far(root)
    try:
        facts = json.loads(begun.read_text())
        return facts | count_attempts(records), records
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{begun}, damaged ({error})", "the facts of a run", "begin the run again") from error


def explain_run(root: Path, task: Task | None = None) -> str:
    """Return the page about a whole run.

    Args:
        root: Of its dataset, or of its failed attempts.
        task: Its task; the one of that name by default.
    """
    from lerobot_demohlm.reports.explain.run_page import run_page

    facts, records = read_run(root)
    return run_page(root, facts, records, task or get_task(facts["task"]))


def explain_attempt(
    root: Path,
    attempt: int,
    task: Task | None = None,
    demonstration: Path | None = None,
    pictures: bool = True,
    episode: int | None = None,
) -> tuple[str, dict[str, Any]]:
    """Make an attempt of a run again.

    Args:
        root: Of the run's dataset, or of its failed attempts.
        attempt: Index of the attempt.
        task: Of the run; the one of that name by default.
        demonstration: Directory of the run's demonstration; the packaged one by default.
        pictures: Whether to draw film strips, which needs graphics.
        episode: Which episode of the dataset it is, where LeRobot has merged several runs.

    Returns:
        The page, and what it says in short.

    Raises:
        DatasetError: There is no such attempt, or the demonstration is not the run's.
    """
    from lerobot_demohlm.generation.stages import Settings
    from lerobot_demohlm.reports.explain.attempt_page import attempt_page
    from lerobot_demohlm.reports.explain.trace import trace

    facts, attempts = read_run(root, episode)
    task = task or get_task(facts["task"])
    records = {record["attempt"]: record for record in attempts}
    if attempt not in records:
        raise DatasetError(f"attempt {attempt}", f"one of {min(records)} to {max(records)}", "choose another --attempt")
    source = demonstrations.load(demonstration, task)
    if source.content_hash != facts["demonstration_hash"]:
        raise DatasetError(
            f"the demonstration {source.content_hash[:12]}",
            f"{facts['demonstration_hash'][:12]}, which the run was made from",
            "name its directory with --demonstration",
        )
    settings = Settings(variation=DataVariation.read(facts))
    controller = controllers.recorded(facts.get("controller_hash"))
    made = trace(task, source, facts["region"], facts["seed"], attempt, settings, controller)
    same = made.episode.digest == records[attempt]["digest"]
    again = agreement(records[attempt], made.episode)
    origin = f"{facts['task']}, {facts['region']}, seed {facts['seed']}, attempt {attempt} of {len(records)}"
    page = attempt_page(made, origin=origin, again=again, pictures=pictures)
    short = {
        "attempt": attempt,
        "outcome": made.episode.outcome,
        "stage": made.episode.stage,
        "reason": made.episode.reason,
        "length_s": round(made.episode.length_s, 3),
        "stage_s": made.episode.record()["stage_s"],
        "same_bits": same,
    }
    return page, short


def agreement(record: Mapping[str, Any], episode: Episode) -> str:
    """Say how an attempt that was made again agrees with the recorded one."""
    if episode.digest == record["digest"]:
        return "Made again for this page: every bit as in the run."
    return (
        f"Made again for this page, and not with the bits of the run, where it ended with {record['outcome']} in "
        f"{record['stage']} after {record['length_s']:.1f} s: `demohlm verify` says what differs in the installation."
    )
