"""``demohlm replay``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm replay``.

    Attributes:
        task: Name of the task, such as LiftBox.
        root: Directory of the demonstration.
    """

    task: str
    root: Annotated[Path | None, default("the packaged one")] = None


def run(options: Options) -> int:
    """Replay a demonstration; exit code 1 where it does not agree with its recording."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.demonstrations.demonstration import load
    from lerobot_demohlm.demonstrations.replay import replay

    outcome = replay(load(options.root, get_task(options.task)))
    print("\n".join(outcome.lines()))
    return 0 if outcome.agrees else 1
