"""Measured numbers -> a JSON line in ``results/``: what was measured, by which command, at which commit."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl


def append_result(path: Path, command: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Append one result with its command and ``commit()``.

    Args:
        path: The ``.jsonl`` file; it and its folder are made if missing.
        command: What was run.
        values: What it found.

    Returns:
        The line.
    """
    line = {**values, "command": command, "commit": commit()}
    jsonl.append(path, [line])
    return line


def commit() -> str:
    """Return the commit of this package's code, with ``+`` where files that git tracks differ from it.

    Files in ``results/`` do not count, as the lines that a run writes there would mark the next run. The commit is
    "unknown" where there is no git, or where the package was installed instead of being run from a repository.
    """
    try:
        if not _git("ls-files", Path(__file__).name):
            return "unknown"  # a repository may hold an environment in which this package is installed
        changed = _git("status", "--porcelain", "-uno", "--", ":/", ":(top,exclude)results")
        return _git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    found = subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    return found.stdout.strip()
