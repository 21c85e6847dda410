"""``demohlm benchmark reach``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark reach``.

    Attributes:
        output: Draw the reachability map into this PNG file.
        num_worlds: Robots stepped together.
        rounds: Random targets a robot, standing and walking each.
        step: Grid of the map [m].
        seed: Seed of the targets.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        num_threads: Threads of the physics.
    """

    output: Annotated[Path | None, default("no map")] = None
    num_worlds: int = 16
    rounds: int = 4
    step: float = 0.1
    seed: int = 0
    controller: str = "default"
    num_threads: int = 2


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.control import controllers
    from gym_demohlm.wbc.evaluation.reach import hand_error, measure_map
    from gym_demohlm.wbc.evaluation.trial import trial_simulation

    simulation = trial_simulation(
        options.num_worlds, num_threads=options.num_threads, weights=controllers.find(options.controller)
    )
    found: dict[str, object] = {**hand_error(simulation, options.seed, options.rounds)}
    if options.output:
        found |= measure_map(simulation, options.step, options.output)
    simulation.close()
    print_json(found | {"seed": options.seed, "num_worlds": options.num_worlds})
