"""Lines of the controller's benchmarks -> tables: its errors, alone, beside others, without a part, and disturbed."""

import math
from collections.abc import Sequence
from typing import Any

from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.rates import markdown

FIRST = "8ac4c8cd0008"
"""The controller of lines from before they named one."""
NUMBERS = {
    "linear_velocity_error": ("linear velocity error, walking, instantaneous", "m/s"),
    "linear_velocity_error_cycle": ("linear velocity error over a gait cycle", "m/s"),
    "yaw_rate_error": ("yaw rate error, walking, instantaneous", "rad/s"),
    "yaw_rate_error_cycle": ("yaw rate error over a gait cycle", "rad/s"),
    "height_error": ("height error, standing", "m"),
    "torso_pitch_error": ("torso pitch error, standing", "rad"),
    "torso_roll_error": ("torso roll error, standing", "rad"),
    "torso_yaw_error": ("torso yaw error, standing", "rad"),
    "standing_drift": ("speed when told to stand", "m/s"),
    "reflex_share": ("share of standing time in steps nobody asked for", "%"),
    "walking_slip": ("slip of the soles that bear load, walking", "m/s"),
    "walking_slip_velocity_only": ("slip, velocity commands only", "m/s"),
    "walking_power": ("mechanical power, walking", "W"),
    "walking_power_velocity_only": ("mechanical power, velocity commands only", "W"),
    "survival": ("no fall in an episode", "%"),
    "survival_pushed": ("no fall, pushed", "%"),
}
"""Number of the benchmark -> what it is, and its unit."""
PUBLISHED = {
    "linear_velocity_error": 0.142,
    "yaw_rate_error": 0.154,
    "height_error": 0.028,
    "torso_pitch_error": 0.049,
    "torso_roll_error": 0.016,
    "torso_yaw_error": 0.013,
}
"""Best of HTD's and AMO's."""
_DISTURBANCES = {
    "none": "none",
    "friction_0.4": "friction 0.4",
    "torso_3kg": "3 kg on the torso",
    "delay_20ms": "joint targets 20 ms late",
    "timestep_1ms": "physics at 1 ms",
}
_ABLATED = (
    "linear_velocity_error",
    "linear_velocity_error_cycle",
    "yaw_rate_error",
    "torso_roll_error",
    "walking_power_velocity_only",
    "survival",
    "survival_pushed",
)


def followed(lines: Sequence[Measurement]) -> str:
    """Return the numbers of each controller, the newest of each, with those of velocity commands alone beside them.

    Args:
        lines: Of ``demohlm benchmark controller``; those of public controllers are left out, see ``pairs``.
    """
    kept = {
        (line.get("controller") or FIRST, bool(line.get("velocity_only"))): line
        for line in lines
        if not line.get("peer")
    }
    order = list(dict.fromkeys(name for name, _ in reversed(kept)))
    runs = [((name, light), kept[name, light]) for name in order for light in (False, True) if (name, light) in kept]
    names = [name for name in NUMBERS if any(line.get(name) is not None for _, line in runs)]
    rows = [
        [_title(name), *(_measured(line, name) for _, line in runs), _cell(PUBLISHED.get(name), name)] for name in names
    ]
    columns = [f"`{name}`" + (", velocity commands only" if light else "") for (name, light), _ in runs]
    sizes = "; ".join(
        f"{column}: {line['num_worlds']} robots for {line['seconds']:.0f} s"
        for column, (_, line) in zip(columns, runs, strict=True)
    )
    note = (
        f"{sizes}. Random commands over the whole range, redrawn every 4 s, arms moving, 0 to 2 kg in each hand; "
        "pushes are 0.5 m/s every 3 s. Velocity commands only: upright, arms still, empty hands. In brackets the lower "
        "end of the 95 % interval. Each controller has the physics that it was trained for. Published errors are "
        "those of HTD and AMO; how they are defined is not known."
    )
    return f"**Whole-body controller**\n\n{markdown(['', *columns, 'best published'], rows)}\n\n{note}"


def robustness(lines: Sequence[Measurement]) -> str:
    """Return how often robots stay up under what training did not aim at."""
    latest = lines[-1]
    rows = [[text, f"{100 * latest[f'survival/{name}']:.1f} %"] for name, text in _DISTURBANCES.items()]
    header = ["disturbance", f"no fall in {latest['seconds']:.0f} s ({latest['num_worlds']} robots each, empty hands)"]
    return "**Whole-body controller outside its training**\n\n" + markdown(header, rows)


def pairs(lines: Sequence[Measurement]) -> str:
    """Return a table for each protocol of ``benchmark controller paired``, then one of all ablations.

    Args:
        lines: Of ``benchmark controller paired`` and ``ablation``, the newest of each pair counts.
    """
    newest = {(line["protocol"], line["physics"], line["beside"], line["controller"]): line for line in lines}
    ablated = [line for line in newest.values() if _part(line)]
    beside = [line for line in newest.values() if not _part(line)]
    kinds = ("protocol", "physics", "beside")
    groups = dict.fromkeys(tuple(line[kind] for kind in kinds) for line in beside)
    parts = [_group([line for line in beside if tuple(line[kind] for kind in kinds) == group]) for group in groups]
    return "\n\n".join([*parts, *([_ablations(ablated)] if ablated else [])])


def _group(lines: Sequence[Measurement]) -> str:
    first = lines[0]
    found = [{row["name"]: row for row in line["rows"]} for line in lines]
    rows = []
    for name in found[0]:
        others = (f"{_cell(rows_of[name]['new'], name)} ({_interval(rows_of[name], name)})" for rows_of in found)
        rows.append([_title(name), _cell(found[0][name]["old"], name), *others])
    header = ["", f"`{first['beside']}`", *(f"{line['controller']} (difference, 95 %)" for line in lines)]
    title = f"**Pairs of controllers**, {_ASKED[first['protocol']]}, {first['physics']} physics"
    return f"{title}\n\n{markdown(header, rows)}\n\n{_size(first)}"


_ASKED = {
    "whole": "all commands, 0 to 2 kg in each hand",
    "arms": "velocities and moving arms of an upright robot, 0 to 2 kg in each hand",
    "velocity": "velocities alone, still and empty arms",
}


def _ablations(lines: Sequence[Measurement]) -> str:
    first = lines[0]
    rows = [["all parts", *(_cell(_row(first, name)["old"], name) for name in _ABLATED)]]
    for line in lines:
        cells = []
        for name in _ABLATED:
            row = _row(line, name)
            clear = row["low"] > 0 or row["high"] < 0
            cells.append(f"**{_cell(row['new'], name)}**" if clear else _cell(row["new"], name))
        rows.append([line["controller"], *cells])
    title = f"**`{first['beside']}` without a part of its settings, or with it as it was at first**, not trained again"
    note = f"{_size(first)} Bold: the 95 % interval of the difference, paired by robots, leaves out zero."
    return f"{title}\n\n{markdown(['', *map(_title, _ABLATED)], rows)}\n\n{note}"


def _part(line: Measurement) -> bool:
    return line["controller"].startswith("without ")


def _row(line: Measurement, name: str) -> dict[str, Any]:
    return next(row for row in line["rows"] if row["name"] == name)


def _size(line: Measurement) -> str:
    return (
        f"{line['num_worlds']} robots of {line['num_seeds']} seeds for {line['seconds']:.0f} s, the same commands, "
        f"loads and pushes (0.5 m/s every 3 s) for all, in the {line['physics']} physics."
    )


def _title(name: str) -> str:
    return NUMBERS[name][0]


def _measured(line: Measurement, name: str) -> str:
    low = line.get(f"{name}_low")
    return _cell(line.get(name), name) + ("" if low is None else f" ({100 * low:.1f})")


def _interval(row: dict[str, Any], name: str) -> str:
    return " to ".join(_cell(row[end], name, signed=True).split(" ")[0] for end in ("low", "high"))


def _cell(value: float | None, name: str, signed: bool = False) -> str:
    """Return a number with its unit; "-" where there is none."""
    if value is None or math.isnan(value):
        return "-"
    unit = NUMBERS[name][1]
    number, digits = (100 * value, 1) if unit == "%" else (value, 1 if unit == "W" else 4 if unit == "m" else 3)
    return f"{number:{'+' if signed else ''}.{digits}f} {unit}"
