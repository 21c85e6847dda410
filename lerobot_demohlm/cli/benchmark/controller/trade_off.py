"""``demohlm benchmark controller trade-off``."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_demohlm.cli.benchmark.controller import Size
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options(Size):
    """Options of ``demohlm benchmark controller trade-off``.

    Attributes:
        root: Folder for the drawing, controller_trade_off.png.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
    """

    root: Path
    controller: str = "default"


def run(options: Options) -> None:
    """Measure and draw; the last line on stdout is the result as JSON."""
    from gym_demohlm.control import controllers
    from gym_demohlm.wbc.evaluation.trade_off import draw_trade_off, trade_off

    found = trade_off(*options.numbers, controllers.find(options.controller))
    options.root.mkdir(parents=True, exist_ok=True)
    draw_trade_off(found, options.root / "controller_trade_off.png")
    print_json(found)
