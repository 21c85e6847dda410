"""Lines of probes of generation -> tables of tasks against groups of a variation, and against ways to replay."""

from collections.abc import Iterable, Sequence

from lerobot_demohlm.checks import portability
from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.tables import markdown
from lerobot_demohlm.experiments.variants import stamp

AGED = " *"  # behind what was measured before the task, the variation or the generator became what it is now


def variation_table(lines: Sequence[Measurement]) -> str:
    """Return strict successes of each task under each variation, the newest of each, a table for each region."""
    order = {name: index for index, name in enumerate(_names(lines, "variation"))}
    names = sorted(order, key=lambda name: (name != "none", ":" not in name, order[name]))
    return _tables("**Generation in worlds that vary**", lines, "variation", names)


def feedback_table(lines: Sequence[Measurement]) -> str:
    """Return strict successes of each task replayed in each way, a table for each region and variation."""
    parts = []
    for variation in _names(lines, "variation"):
        chosen = [line for line in lines if line["variation"] == variation]
        parts.append(_tables(f"**Less feedback**, `{variation}`", chosen, "replay", _names(chosen, "replay")))
    return "\n\n".join(parts)


def _tables(title: str, lines: Sequence[Measurement], column: str, names: Sequence[str]) -> str:
    parts = []
    for region in sorted(_names(lines, "region")):
        found = {(line["task"], line[column]): line for line in lines if line["region"] == region}
        tasks = sorted({task for task, _ in found})
        shown = [name for name in names if any((task, name) in found for task in tasks)]
        rows = [[task, *(_cell(found.get((task, name))) for name in shown)] for task in tasks]
        note = "A cell is the share of attempts that succeed by the strict judge, and how many attempts there were."
        if any(AGED in cell for row in rows for cell in row):
            note += " \\* marks what was measured before the task, its worlds or the generator changed."
        parts.append(f"{title}, {region}\n\n{markdown(['task', *map(_code, shown)], rows)}\n\n{note}")
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


def _code(name: str) -> str:
    return f"`{name}`"
