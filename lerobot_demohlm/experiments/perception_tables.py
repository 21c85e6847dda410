"""Lines of what eyes see -> tables: how near ``rgbd`` comes to the truth, how its model errs, what policies bear."""

from collections.abc import Sequence

from lerobot_demohlm.experiments.lines import Measurement, newest
from lerobot_demohlm.experiments.rates import markdown, measured_age


def tracking_table(lines: Sequence[Measurement]) -> str:
    """Return errors of ``rgbd`` for each object, the newest of each, and the processor time of a frame."""
    found = newest(lines, "task", "object")
    common, ages = _ages(found)
    rows = [
        [
            f"{line['task']} {line['object']}{aged}",
            f"{line['frames_seen']} of {line['frames']}",
            _both(line["position_mm"]),
            _both(line["turn_deg"]),
            f"{100 * line['lost_share']:.1f} %",
            str(line["found_again_late"]),
            _both(line["frame_cpu_ms"]),
        ]
        for line, aged in zip(found, ages, strict=True)
    ]
    header = ["task, object", "frames that show it", "off [mm]", "turned [deg]", "not found", "late", "a frame [ms]"]
    note = (
        "Medians and, in brackets, 95 % quantiles. A frame shows an object of which at least 20 % is visible; one that "
        "was not found for more than 0.5 s is late. Of round things the turn is that of the axis. A frame is the "
        "processor time of drawing, noise, masks and tracking of all objects of the task."
    )
    return f"**Object poses as `rgbd` sees them**{common}\n\n{markdown(header, rows)}\n\n{note}"


def fit_table(lines: Sequence[Measurement]) -> str:
    """Return quantiles of the errors of ``rgbd`` and of its fitted model, the newest of each object."""
    names = ("shift_mm_q50", "shift_mm_q90", "turn_deg_q50", "turn_deg_q90")
    found = newest([line for line in lines if line.get("fresh_attempts")], "task", "object")
    common, ages = _ages(found)
    rows = [
        [
            f"{line['task']} {line['object']}{aged}",
            f"{line['fitted_to']['attempts']}, {line['fresh_attempts']}",
            *(f"{line['rgbd'][name]:.2g}, {line['model'][name]:.2g}" for name in names),
            f"{100 * line['largest_deviation']:.0f} %",
        ]
        for line, aged in zip(found, ages, strict=True)
    ]
    header = ["task, object", "episodes: fitted to, fresh", "off, median [mm]: `rgbd`, `model`", "90 %"]
    header += ["turned, median [deg]", "90 %", "largest deviation"]
    return (
        f"**Errors of `rgbd` and of the model fitted to them**, on fresh episodes{common}\n\n{markdown(header, rows)}"
    )


def curves_table(lines: Sequence[Measurement]) -> str:
    """Return the success of each policy under each perception, the newest of each."""
    latest = newest(lines, "task", "region", "policy_hash", "perception")
    seen = dict.fromkeys(line["perception"] for line in lines)
    found = {(line["task"], line["region"], line["policy_hash"], line["perception"]): line for line in latest}
    policies = {(line["task"], line["region"], line["policy_hash"]): line for line in latest}
    common, ages = _ages(list(policies.values()))
    header = ["perception"]
    for (task, region, _), line, aged in zip(policies, policies.values(), ages, strict=True):
        header.append(f"{task} {region}, {line['policy']}{aged}")
    rows = [[f"`{name}`", *(_success(found.get((*policy, name))) for policy in policies)] for name in seen]
    note = "Share of rollouts in the plain world that succeed by the strict judge, with its 95 % interval."
    return f"**Policies whose eyes err**, one error at a time{common}\n\n{markdown(header, rows)}\n\n{note}"


def _ages(lines: Sequence[Measurement]) -> tuple[str, list[str]]:
    """Return what stands behind a table of measurements, and behind each where they differ."""
    ages = [measured_age(line) for line in lines]
    return (ages[0], [""] * len(ages)) if len(set(ages)) == 1 else ("", ages)


def _success(line: Measurement | None) -> str:
    if line is None:
        return ""
    low, high = line["success_strict"]["interval"]
    return f"{100 * line['success_strict']['rate']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _both(quantiles: dict[str, float]) -> str:
    return f"{quantiles['median']:.2g} ({quantiles['p95']:.2g})"
