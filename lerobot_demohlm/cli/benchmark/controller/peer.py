"""``demohlm benchmark controller peer``."""

from dataclasses import dataclass

from lerobot_demohlm.cli.benchmark.controller import Commands
from lerobot_demohlm.cli.choices import Peer
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options(Commands):
    """Options of ``demohlm benchmark controller peer``.

    Attributes:
        name: The public controller.
        own_range: Draw velocities from the range that the public controller was trained for.
    """

    name: Peer = "holosoma"
    own_range: bool = False


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.wbc.evaluation.peer import benchmark

    found = benchmark(
        options.name,
        *options.numbers,
        options.ranges,
        largest_hand_load=options.hand_load,
        own_range=options.own_range,
    )
    print_json(found)
