"""Measured results as JSON lines in ``results/``: what was measured, by which command, at which commit."""

import json
import subprocess
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError

Line = dict[str, Any]


def append(path: Path, command: str, values: Line) -> Line:
    """Append one result with its command and the commit of the working tree (``+`` where files differ from it).

    Args:
        path: The ``.jsonl`` file.
        command: What was run.
        values: What it found.
    """
    line = {**values, "command": command, "commit": _commit()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
    return line


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=False).stdout.strip()

    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if git("status", "--porcelain", "-uno") else "")


def read(path: Path) -> list[Line]:
    """Return the lines of a file, none where it does not exist.

    Raises:
        DatasetError: A line is not a JSON object.
    """
    if not path.exists():
        return []
    lines = []
    for number, text in enumerate(path.read_text().splitlines(), start=1):
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            line = None
        if not isinstance(line, dict):
            raise DatasetError(f"{path.name}:{number} that is no JSON object", "one a line", "delete or mend the line")
        lines.append(line)
    return lines
