"""``demohlm record``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gym_demohlm.errors import DemonstrationError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm record``.

    Attributes:
        task: Name of the task, such as LiftBox.
        teleop: Who operates the robot.
        root: Directory to write; must not exist.
    """

    task: str
    teleop: Literal["scripted"] = "scripted"
    root: Path


def run(options: Options) -> None:
    """Record a demonstration with the task's scripted operator."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.teleop.record import record, script_of

    task = get_task(options.task)
    if options.root.exists():
        raise DemonstrationError(f"the root {options.root}, which exists", "a new path", "choose another --root")
    script = script_of(task)
    demonstration = record(task, script.make_operator(), script.start)
    demonstration.save(options.root, task)
    print(f"{options.root}: {len(demonstration)} ticks by {demonstration.metadata['operator']}")
