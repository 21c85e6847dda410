"""``demohlm benchmark controller figures``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark controller figures``.

    Attributes:
        root: Folder for figures and video.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        run: Folder of a training run, whose learning curve is drawn.
        seed: Seed of the pushes.
        num_threads: Threads of the physics.
    """

    root: Path
    controller: str = "default"
    run: Annotated[Path | None, default("no learning curve")] = None
    seed: int = 0
    num_threads: int = 2


def run(options: Options) -> None:
    """Draw; the last line on stdout is the names of the files and the numbers behind them as JSON."""
    from gym_demohlm.control import controllers
    from gym_demohlm.wbc.evaluation.figures import draw

    print_json(draw(options.root, controllers.find(options.controller), options.run, options.seed, options.num_threads))
