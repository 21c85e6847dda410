"""Results -> JSON of a readable length."""

import json


def print_json(found: object) -> None:
    """Print numbers, also those in lists and mappings, with five digits after the point, as one line of JSON."""
    print(json.dumps(rounded(found)))


def rounded(value: object) -> object:
    """Return a value with five digits after the point in each of its numbers."""
    if isinstance(value, dict):
        return {name: rounded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [rounded(entry) for entry in value]
    return round(value, 5) if isinstance(value, float) else value
