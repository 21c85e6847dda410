"""``demohlm benchmark controller robustness``."""

from dataclasses import dataclass

from lerobot_demohlm.cli.benchmark.controller import Size
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options(Size):
    """Options of ``demohlm benchmark controller robustness``."""


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.wbc.evaluation.benchmark import robustness

    print_json(robustness(*options.numbers))
