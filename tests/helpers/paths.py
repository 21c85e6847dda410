"""Where the repository is, and what belongs to it."""

import functools
import subprocess
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


@functools.cache
def tracked() -> frozenset[Path]:
    """Return the files that git keeps and their folders, and nothing that merely lies beside them.

    Where there is no git, as in an archive, they are all but what is in hidden folders.
    """
    if (REPOSITORY / ".git").exists():
        command = ["git", "ls-files", "-z"]
        names = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.split("\0")
        files = [path for name in names if name and (path := REPOSITORY / name).is_file()]
        return frozenset(part for file in files for part in (file, *file.parents))
    shown = [path for path in REPOSITORY.iterdir() if not path.name.startswith(".")]
    return frozenset(part for path in shown for part in (path, *path.rglob("*")))
