"""The factors -> the tables of docs/variation.md: ``python -m gym_demohlm.variation.table docs/variation.md``."""

import sys
from pathlib import Path

from gym_demohlm.errors import DatasetError
from gym_demohlm.files import replace_text
from gym_demohlm.variation.factors import FACTORS, GROUPS, Factor, Range

BEGIN, END = "<!-- factors -->", "<!-- /factors -->"
_HEAD = "| factor | unit | numbers | `real` | `hard` | what it is | source |\n|---|---|---|---|---|---|---|"
_TARGETS = {"episode": "", "object": " an object", "limb": " a limb", "clutter": " a can"}


def tables() -> str:
    """Return one Markdown table a group."""
    parts = []
    for group in GROUPS:
        factors = [factor for factor in FACTORS.values() if factor.group == group]
        if factors:
            parts += [f"### `{group}`", "\n".join([_HEAD, *map(_row, factors)])]
    return "\n\n".join(parts)


def filled(text: str) -> str:
    """Return a page with the tables of today between its markers.

    Raises:
        DatasetError: The page has no markers.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise DatasetError("a page without markers", f"{BEGIN} and {END}", "restore them")
    return f"{before}{BEGIN}\n{tables()}\n{END}{after}"


def _row(factor: Factor) -> str:
    count = f"{factor.size}{_TARGETS[factor.each]}"
    cells = (f"`{factor.name}`", factor.unit, count, _range(factor.real), _range(factor.hard), factor.meaning)
    return f"| {' | '.join(cells)} | {factor.source} |"


def _range(range_: Range) -> str:
    return f"{range_[0]:g} to {range_[1]:g}"


if __name__ == "__main__":
    page = Path(sys.argv[1])
    replace_text(page, filled(page.read_text()))
