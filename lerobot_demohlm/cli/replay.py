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
    """Replay a demonstration; exit code 1 where any bit differs."""
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.demonstrations.demonstration import load
    from lerobot_demohlm.demonstrations.replay import replay

    outcome = replay(load(options.root, get_task(options.task)))
    for remark in outcome.remarks:
        print(remark)
    if outcome.identical:
        print(f"{outcome.num_ticks} ticks replayed: every bit as recorded")
        return 0
    where = (
        "in the final state only" if outcome.first_difference is None else f"from tick {outcome.first_difference} on"
    )
    print(
        f"{outcome.num_ticks} ticks replayed: different {where}, joints by up to {outcome.largest_difference:.2e} rad; "
        "bits hold for one version of MuJoCo and one family of processors"
    )
    return 1
