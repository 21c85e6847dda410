"""The record of a deployment -> one HTML page: what the robot did and why, ages of what it knew, joints, limits."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from gym_demohlm.control import command
from gym_demohlm.errors import DatasetError
from gym_demohlm.robot import g1
from lerobot_demohlm.drawing import INK
from lerobot_demohlm.hardware import recorder
from lerobot_demohlm.hardware.control_process import CHANGES
from lerobot_demohlm.hardware.deployment import FACTS
from lerobot_demohlm.hardware.limits import Ages
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.reports.explain.figures import COLOURS, Curve, chart
from lerobot_demohlm.reports.explain.pages import render

MODE_COLOURS = {Mode.DAMP: "#f6ded9", Mode.STAND: "#fbf1dc", Mode.RUN: "#e4f1e7", Mode.HOLD: "#e3edf7"}
_AGES = ("state", "policy", "pose", "servos", "operator", "recorder")
_SHOWN = 1.0  # s: older values are drawn here


def is_deployment(root: Path) -> bool:
    """Return whether a directory is the record of a deployment."""
    return (root / FACTS).is_file()


def explain_deployment(root: Path) -> tuple[str, dict[str, Any]]:
    """Return the page about a deployment, and what it says in short.

    Args:
        root: Directory of its record.

    Raises:
        DatasetError: It holds no rows, or something else.
    """
    try:
        facts, rows = json.loads((root / FACTS).read_text()), recorder.read(root)
    except (OSError, ValueError, pa.ArrowInvalid) as error:
        raise DatasetError(
            f"{root} that cannot be read ({error})", "a record of `demohlm deploy`", "check --root"
        ) from error
    if facts["mode"] is None:
        last = Mode(rows["control.mode"][-1].as_py()).name
        facts |= {
            "mode": last,
            "reason": f"{rows['control.reason'][-1]} (the last of its rows; its end is not recorded)",
        }
    time_s = 1e-9 * np.asarray(rows["time_ns"], dtype=np.float64)
    time_s -= time_s[0]
    changes = mode_changes(time_s, rows)
    ages = age_rows(rows)
    short = {
        "task": facts["task"],
        "seconds": round(float(time_s[-1]), 2),
        "ended": f"{facts['mode']}: {facts['reason']}",
        "changes": [f"{at:.2f} s {mode}: {reason}" for at, mode, reason in changes],
    }
    page = render(
        "deployment.html.j2",
        title=f"{facts['task']} on {facts['interface']}: {time_s[-1]:.1f} s",
        facts=facts,
        changes=changes,
        ages=ages,
        met=limits_met(rows),
        charts=charts(time_s, rows, changes),
        count=len(time_s),
    )
    return page, short


def mode_changes(time_s: np.ndarray, rows: pa.Table) -> list[tuple[float, str, str]]:
    """Return when [s] the robot began to do what, and why."""
    modes, reasons = rows["control.mode"].to_pylist(), rows["control.reason"].to_pylist()
    found: list[tuple[float, str, str]] = []
    for at, mode, reason in zip(time_s, modes, reasons, strict=True):
        entry = Mode(mode).name, reason
        if not found or found[-1][1:] != entry:
            found.append((float(at), *entry))
    return found


def age_rows(rows: pa.Table) -> list[dict[str, Any]]:
    """Return median and 99th percentile of each age at the controller [ms] while it ran, and its limit."""
    running = np.asarray(rows["control.mode"]) == Mode.RUN
    found = []
    for name in _AGES:
        values = 1e3 * np.asarray(rows[f"control.{name}_age_s"], dtype=np.float64)[running]
        values = values[np.isfinite(values)]
        if len(values) and values.max() > 0.0:
            p50, p99 = np.percentile(values, (50, 99))
            limit = 1e3 * getattr(Ages(), name)
            found.append(
                {"name": name, "p50": float(p50), "p99": float(p99), "max": float(values.max()), "limit": limit}
            )
    return found


def limits_met(rows: pa.Table) -> dict[str, int]:
    """Return in how many ticks the safety filter met each limit."""
    bits = np.asarray(rows["control.changed"])
    return {name: int(((bits >> index) & 1).sum()) for index, name in enumerate(CHANGES)}


def charts(time_s: np.ndarray, rows: pa.Table, changes: Sequence[tuple[float, str, str]]) -> list[Any]:
    """Return curves over time on a background of modes."""
    end = float(time_s[-1])
    stops = [*(at for at, _, _ in changes[1:]), end]
    bands = [(at, stop, MODE_COLOURS[Mode[mode]]) for (at, mode, _), stop in zip(changes, stops, strict=True)]

    def table(name: str) -> np.ndarray:
        return np.array(rows[name].to_pylist(), dtype=np.float64)

    def ages(name: str) -> np.ndarray:
        return np.minimum(table(f"control.{name}_age_s"), _SHOWN)

    told, q, sent = table("control.command"), table("state.q"), table("control.sent_q")
    kp, kd, dq = table("control.kp"), table("control.kd"), table("state.dq")
    torque = np.abs(kp * (sent - q) - kd * dq) / np.array([g1.motor(joint).torque_limit for joint in g1.BODY_JOINTS])
    error = np.where(kp > 0.0, np.abs(sent - q), np.nan)
    parts = {"legs": slice(0, 12), "waist": slice(12, 15), "arms": slice(15, 29)}
    names = command.NAMES[command.VELOCITY]
    return [
        chart(
            "Ages at the controller [s]",
            [Curve(name=name, values=ages(name), colour=COLOURS[i]) for i, name in enumerate(_AGES[:3])],
            end, bands,
        ),
        chart(
            "Velocity of the base, commanded [m/s, rad/s]",
            [Curve(name=name, values=told[:, i], colour=COLOURS[i]) for i, name in enumerate(names)],
            end, bands,
        ),
        chart(
            "Largest distance of a joint from its target [rad]",
            [
                Curve(name=name, values=_largest(error[:, part]), colour=colour)
                for (name, part), colour in zip(parts.items(), COLOURS, strict=False)
            ],
            end, bands,
        ),
        chart(
            "Largest share of a motor's torque that the PD asks for",
            [
                Curve(name=name, values=_largest(torque[:, part]), colour=colour)
                for (name, part), colour in zip(parts.items(), COLOURS, strict=False)
            ],
            end, bands,
        ),
        chart("Lean of the pelvis [rad]", [Curve(name="", values=table("control.tilt"), colour=INK)], end, bands),
    ]  # fmt: skip


def _largest(values: np.ndarray) -> np.ndarray:
    """Return the largest of each row; NaN where all are."""
    filled = np.where(np.isnan(values), -np.inf, values).max(axis=1)
    return np.where(np.isneginf(filled), np.nan, filled)
