"""``demohlm push``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm push``.

    Attributes:
        root: Dataset of `demohlm generate`.
        repo_id: Name on the hub, user/name.
        branch: Branch to push to.
        private: Make a new repository a private one.
    """

    root: Path
    repo_id: str
    branch: Annotated[str | None, default("the main one")] = None
    private: bool = False


def run(options: Options) -> None:
    """Push a dataset; the last line on stdout is its address."""
    from lerobot_demohlm.datasets.hub import push

    print(push(options.root, options.repo_id, private=options.private or None, branch=options.branch))
