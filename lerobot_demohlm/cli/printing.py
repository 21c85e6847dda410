"""Results -> JSON of a readable length, and tables of comparisons."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def print_json(found: object) -> None:
    """Print numbers, also those in lists and mappings, with five digits after the point, as one line of JSON."""
    print(json.dumps(rounded(found)))


def rounded(value: Any) -> Any:  # noqa: ANN401
    """Return a value with five digits after the point in each of its numbers."""
    if isinstance(value, dict):
        return {name: rounded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [rounded(entry) for entry in value]
    return round(value, 5) if isinstance(value, float) else value


def print_comparisons(found: Iterable[Mapping[str, Any]], command: str, append: Path | None) -> None:
    """Print each comparison of ``contest`` as a table, all of them as JSON at last, and add them to a file.

    Args:
        found: As ``contest`` yields them.
        command: What was called.
        append: File of JSON lines; None for none.
    """
    from lerobot_demohlm.reproducibility.results import append_result

    lines = []
    for comparison in found:
        line = rounded(dict(comparison))
        lines.append(line)
        print(f"{line['controller']} beside {line['beside']}; difference with its 95 % interval")
        for row in line["rows"]:
            print(f"  {row['name']:<30} {row['new']:9.4f} {row['old']:9.4f}   {row['low']:+.4f} to {row['high']:+.4f}")
        if append is not None:
            append_result(append, command, line)
    print_json(lines)
