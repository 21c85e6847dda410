"""``demohlm quickstart``."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_demohlm.quickstart import Quickstart
from lerobot_demohlm.quickstart import run as run_quickstart


@dataclass(frozen=True, kw_only=True)
class Options(Quickstart):
    """Options of ``demohlm quickstart``."""

    root: Path = Path("outputs/quickstart")


def run(options: Options) -> None:
    """Run the quickstart; the last line on stdout is the path of the report."""
    print(run_quickstart(options))
