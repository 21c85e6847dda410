"""Lines of what eyes see -> tables: how near ``rgbd`` comes to the truth, and how like it its fitted model errs."""

from collections.abc import Sequence

from lerobot_demohlm.experiments.lines import Measurement, newest
from lerobot_demohlm.experiments.tables import markdown


def tracking_table(lines: Sequence[Measurement]) -> str:
    """Return errors of ``rgbd`` for each object, the newest of each, and the processor time of a frame."""
    rows = [
        [
            f"{line['task']} {line['object']}",
            f"{line['frames_seen']} of {line['frames']}",
            _both(line["position_mm"]),
            _both(line["turn_deg"]),
            f"{100 * line['lost_share']:.1f} %",
            str(line["found_again_late"]),
            _both(line["frame_cpu_ms"]),
        ]
        for line in newest(lines, "task", "object")
    ]
    header = ["task, object", "frames that show it", "off [mm]", "turned [deg]", "not found", "late", "a frame [ms]"]
    note = (
        "Medians and, in brackets, 95 % quantiles. A frame shows an object of which at least 20 % is visible; one that "
        "was not found for more than 0.5 s is late. Of round things the turn is that of the axis. A frame is the "
        "processor time of drawing, noise, masks and tracking of all objects of the task."
    )
    return f"**Object poses as `rgbd` sees them**\n\n{markdown(header, rows)}\n\n{note}"


def fit_table(lines: Sequence[Measurement]) -> str:
    """Return quantiles of the errors of ``rgbd`` and of its fitted model, the newest of each object."""
    names = ("shift_mm_q50", "shift_mm_q90", "turn_deg_q50", "turn_deg_q90")
    rows = [
        [
            f"{line['task']} {line['object']}",
            f"{line['fitted_to']['attempts']}, {line['fresh_attempts']}",
            *(f"{line['rgbd'][name]:.2g}, {line['model'][name]:.2g}" for name in names),
            f"{100 * line['largest_deviation']:.0f} %",
        ]
        for line in newest([line for line in lines if line.get("fresh_attempts")], "task", "object")
    ]
    header = ["task, object", "episodes: fitted to, fresh", "off, median [mm]: `rgbd`, `model`", "90 %"]
    header += ["turned, median [deg]", "90 %", "largest deviation"]
    return f"**Errors of `rgbd` and of the model fitted to them**, on fresh episodes\n\n{markdown(header, rows)}"


def _both(quantiles: dict[str, float]) -> str:
    return f"{quantiles['median']:.2g} ({quantiles['p95']:.2g})"
