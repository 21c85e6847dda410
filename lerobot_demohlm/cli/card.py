"""``demohlm card``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm card``.

    Attributes:
        root: Dataset of `demohlm generate`; without it, all cards of the folder are rendered again.
        repo_id: Name on the hub, user/name; needed with --root.
        folder: Folder of ready cards.
    """

    root: Annotated[Path | None, default("none")] = None
    repo_id: Annotated[str | None, default("none")] = None
    folder: Path = Path("dataset_cards")


def run(options: Options) -> None:
    """Write the card of a dataset with its facts beside it, or render all cards again."""
    from lerobot_demohlm.datasets.card import render_ready_cards, write_ready_card
    from lerobot_demohlm.datasets.hub import require_repo_id

    if (options.root is None) != (options.repo_id is None):
        raise DatasetError("one of --root and --repo-id", "both or none", "give the other one too")
    if options.root is None or options.repo_id is None:
        for path in render_ready_cards(options.folder):
            print(path)
    else:
        require_repo_id(options.repo_id)
        print(write_ready_card(options.root, options.repo_id, options.folder))
