"""``demohlm controllers``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from lerobot_demohlm.cli.parsing import default

_SHOWN = {
    "linear_velocity_error": "velocity [m/s]",
    "yaw_rate_error": "yaw rate [rad/s]",
    "height_error": "height [m]",
    "torso_pitch_error": "pitch [rad]",
    "survival": "stays up",
    "survival_pushed": "pushed",
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm controllers``.

    Attributes:
        results: File of JSON lines of `demohlm benchmark controller` with the measured numbers.
    """

    results: Annotated[Path | None, default("the lines in the package")] = None


def run(options: Options) -> None:
    """Print a table, then one line of JSON; a controller's numbers are those of its latest line over all commands."""
    from gym_demohlm import jsonl
    from gym_demohlm.control import controllers
    from gym_demohlm.control.whole_body import Weights

    lines = jsonl.read(options.results or controllers.MEASURED)
    measured = {line["controller"]: line for line in lines if "controller" in line and not line.get("velocity_only")}
    rows: list[dict[str, Any]] = []
    for controller in controllers.installed():
        weights = Weights(controller.path)
        numbers = measured.get(controller.name, {})
        rows.append(
            {
                "name": controller.name,
                "default": controller.is_default,
                "physics": weights.settings.physics.name,
                "steps": weights.metadata.get("steps"),
                **{name: numbers.get(name) for name in _SHOWN},
            }
        )
    print("  ".join(["name        ", "physics", "M steps", *_SHOWN.values()]))
    for row in rows:
        steps = "" if row["steps"] is None else f"{row['steps'] / 1e6:.1f}"
        cells = [f"{row['name']:<12}", f"{row['physics']:<7}", f"{steps:>7}"]
        cells += [_cell(row[name], len(title)) for name, title in _SHOWN.items()]
        print("  ".join(cells) + ("  (default)" if row["default"] else ""))
    print(json.dumps(rows))


def _cell(value: float | None, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3f'):>{width}}"
