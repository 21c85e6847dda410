"""Measured numbers -> a JSON line in ``results/``: what was measured, by which command, at which commit."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl


def append_result(path: Path, command: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Append one result with its command and the commit of the working tree (``+`` where files differ from it).

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
    """Return the commit of the working tree, with ``+`` where tracked files differ from it; "unknown" without git."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=False).stdout.strip()

    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if git("status", "--porcelain", "-uno") else "")
