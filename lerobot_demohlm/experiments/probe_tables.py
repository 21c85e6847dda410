"""Lines of probes of generation -> tables of tasks against groups of a variation, and against ways to replay."""

from collections.abc import Iterable, Sequence

from lerobot_demohlm.checks import portability
from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.rates import markdown
from lerobot_demohlm.experiments.variants import stamp

_Side = tuple[str, Sequence[str]]  # what lines have as a row's or a column's name, and the names in their order
AGED = " *"  # behind what was measured before the task, the variation or the generator became what it is now


def variation_table(lines: Sequence[Measurement]) -> str:
    """Return strict successes of each task under each variation, the newest of each, a table for each region."""
    order = {name: index for index, name in enumerate(_names(lines, "variation"))}
    names = sorted(order, key=lambda name: (name != "none", ":" not in name, order[name]))
    rows, columns = ("task", sorted(_names(lines, "task"))), ("variation", names)
    return _tables("**Generation in worlds that vary**", lines, rows, columns)


def feedback_table(lines: Sequence[Measurement]) -> str:
    """Return strict successes of each way to replay each task, a table for each region and variation."""
    parts = []
    for variation in _names(lines, "variation"):
        chosen = [line for line in lines if line["variation"] == variation]
        rows, columns = ("replay", _names(chosen, "replay")), ("task", _names(chosen, "task"))
        parts.append(_tables(f"**Less feedback**, `{variation}`", chosen, rows, columns))
    return "\n\n".join(parts)


def _tables(title: str, lines: Sequence[Measurement], rows: _Side, columns: _Side) -> str:
    parts = []
    for region in sorted(_names(lines, "region")):
        found = {(line[rows[0]], line[columns[0]]): line for line in lines if line["region"] == region}
        beside = [name for name in rows[1] if any(row == name for row, _ in found)]
        above = [name for name in columns[1] if any(column == name for _, column in found)]
        body = [[_shown(rows, row), *(_cell(found.get((row, column))) for column in above)] for row in beside]
        note = "A cell is the share of attempts that succeed by the strict judge, and how many attempts there were."
        if any(AGED in cell for row in body for cell in row):
            note += " \\* marks what was measured before the task, its worlds or the generator changed."
        head = [rows[0], *(_shown(columns, column) for column in above)]
        parts.append(f"{title}, {region}\n\n{markdown(head, body)}\n\n{note}")
    return "\n\n".join(parts)


def _cell(line: Measurement | None) -> str:
    if line is None:
        return "-"
    return f"{100 * line['strict'] / line['attempts']:.0f} % of {line['attempts']}{AGED if _is_aged(line) else ''}"


def _is_aged(line: Measurement) -> bool:
    """Tell whether a line is of an earlier version, as far as that is known without an attempt."""
    if line["stamp"] != stamp(line["task"]):
        return True
    preset = line["variation"].split(":")[0].split("@")[0]
    return preset != "none" and not line.get("worlds", "").startswith(portability.recipe(preset))


def _names(lines: Iterable[Measurement], key: str) -> list[str]:
    return list(dict.fromkeys(line[key] for line in lines))


def _shown(side: _Side, name: str) -> str:
    return name if side[0] == "task" else f"`{name}`"
