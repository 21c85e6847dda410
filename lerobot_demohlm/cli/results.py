"""``demohlm results``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm results``.

    Attributes:
        results: Folder of JSON lines.
        readme: Put the tables into this file instead of printing them.
    """

    results: Path = Path("results")
    readme: Annotated[Path | None, default("print them")] = None


def run(options: Options) -> None:
    """Print the tables, or put them into a file."""
    from lerobot_demohlm.experiments.readme_tables import tables, update_readme

    if options.readme is None:
        print(tables(options.results))
    elif update_readme(options.readme, options.results):
        print(f"updated {options.readme}")
