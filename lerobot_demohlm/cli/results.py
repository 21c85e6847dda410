"""``demohlm results``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm results``.

    Attributes:
        results: Folder of JSON lines.
        output: Write all tables to this file, such as docs/results.md.
        readme: Put the table with one row a task between the markers of this file.
        pages: Put tables between the markers of these files too, such as docs/perception.md.
    """

    results: Path = Path("results")
    output: Annotated[Path | None, default("print them")] = None
    readme: Annotated[Path | None, default("none")] = None
    pages: Annotated[tuple[Path, ...], default("none")] = ()


def run(options: Options) -> None:
    """Print all tables, or write the files that are named.

    Raises:
        DatasetError: There is no folder of results.
    """
    from lerobot_demohlm.experiments.readme_tables import tables, update_page, write_results

    if not options.results.is_dir():
        raise DatasetError(f"no folder {options.results}", "a folder of JSON lines", "check --results")
    pages = (*([options.readme] if options.readme else []), *options.pages)
    if options.output is None and not pages:
        print(tables(options.results))
    if options.output is not None and write_results(options.output, options.results):
        print(f"updated {options.output}")
    for page in pages:
        if update_page(page, options.results):
            print(f"updated {page}")
