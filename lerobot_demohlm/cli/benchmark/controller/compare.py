"""``demohlm benchmark controller compare``."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark controller compare``.

    Attributes:
        root: Folder for the drawing, controller_comparison.png.
        runs: Folders of training runs.
    """

    root: Path
    runs: tuple[Path, ...]


def run(options: Options) -> None:
    """Draw; the last line on stdout is the name of the file as JSON."""
    from gym_demohlm.wbc.evaluation.figures import draw_comparison

    options.root.mkdir(parents=True, exist_ok=True)
    draw_comparison(options.runs, options.root / "controller_comparison.png")
    print_json({"figures": ["controller_comparison.png"]})
