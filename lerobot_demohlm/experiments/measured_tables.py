"""Lines of benchmarks and checks, a file each in ``results/``, -> the tables of ``docs/results.md`` made from them."""

from collections.abc import Callable, Sequence

from lerobot_demohlm.experiments.controller_tables import followed, pairs, robustness
from lerobot_demohlm.experiments.lines import Measurement, newest
from lerobot_demohlm.experiments.perception_tables import curves_table, fit_table, tracking_table
from lerobot_demohlm.experiments.probe_tables import feedback_table, variation_table
from lerobot_demohlm.experiments.rates import markdown, measured_age

SHARES = {
    "mj_step": "`mj_step`",
    "controller": "controller",
    "inverse_kinematics": "inverse kinematics",
    "writing": "writing",
    "python": "the rest",
}


def _time(lines: Sequence[Measurement]) -> str:
    rows = [
        [
            line["task"] + measured_age(line),
            line["region"],
            f"{line['successes']} of {line['attempts']}",
            f"{line['seconds_per_episode']:.2f} s",
            f"{line['simulated_s_per_episode']:.1f} s",
            *(f"{100 * line[f'{name}_share']:.0f} %" for name in SHARES),
        ]
        for line in newest(lines, "task", "region")
    ]
    header = ["task", "region", "succeeded", "CPU time an episode", "simulated"]
    header += [f"in {of}" for of in SHARES.values()]
    return "**Time to generate**, and where it goes\n\n" + markdown(header, rows)


def _varied_speed(lines: Sequence[Measurement]) -> str:
    rows = [
        [
            line["task"] + measured_age(line),
            line["region"],
            f"`{line['variation']}`",
            f"{line['plain_steps_per_s']:,}",
            f"{line['steps_per_s']:,}",
            f"{100 * line['speed']:.0f} %",
        ]
        for line in newest(lines, "task", "region", "variation")
    ]
    header = ["task", "region", "worlds", "plain", "varied", "varied against plain"]
    title = "**Speed of generation in worlds that vary**: physics steps a second of CPU time, both in one run"
    return f"{title}\n\n{markdown(header, rows)}"


def _rate(ours: str, theirs: str, ratio: str) -> Callable[[Measurement], tuple[str, str, str]]:
    """Return what picks a rate, the one beside it and their ratio from a line."""
    return lambda line: (f"{line[ours]:,}", f"{line[theirs]:,}", f"{line[ratio]:g}")


_SPEED: dict[str, tuple[str, str, Callable[[Measurement], tuple[str, str, str]]]] = {
    "simulation": (
        "physics steps a second, controller and sensors included",
        "bare `mj_step`, same model, states and threads",
        _rate("steps_per_s", "mj_steps_per_s", "step_efficiency"),
    ),
    "dataset": (
        "state-only episodes written a second",
        "LeRobot's `save_episode`",
        _rate("episodes_per_s", "lerobot_episodes_per_s", "write_speedup"),
    ),
    "memory": (
        "MiB held by the process that merges a run",
        "after a tenth of its episodes",
        lambda line: (
            f"{line['rss_after_all_mb']} after {line['run_episodes']} episodes",
            f"{line['rss_after_a_tenth_mb']}",
            f"{line['rss_after_all_mb'] / line['rss_after_a_tenth_mb']:.2f}",
        ),
    ),
    "loading": (
        "samples loaded a second (chunk {chunk}, batch {batch_size})",
        "`LeRobotDataset`",
        _rate("memory_samples_per_s", "lerobot_samples_per_s", "ratio"),
    ),
    "training": (
        "samples trained on a second ({policy}, {preset}, batch {batch_size})",
        "`lerobot-train`, {lerobot_num_workers} processes that load",
        _rate("samples_per_s", "lerobot_samples_per_s", "ratio"),
    ),
    "evaluation": (
        "rollouts an hour, {num_workers} processes of {num_worlds} worlds",
        "`lerobot-eval`, {lerobot_worlds} at a time, its films drawn",
        _rate("rollouts_per_hour", "lerobot_rollouts_per_hour", "ratio"),
    ),
}


def _speed(lines: Sequence[Measurement]) -> str:
    latest = {(line["benchmark"], line.get("lerobot_worlds"), line.get("policy")): line for line in lines}
    rows = []
    for (name, *_), line in sorted(latest.items(), key=lambda entry: list(_SPEED).index(entry[0][0])):
        what, beside, pick = _SPEED[name]
        ours, theirs, ratio = pick(line)
        rows.append([what.format(**line.values), ours, f"{theirs} ({beside.format(**line.values)})", ratio])
    return "**Speed**, both measured in one run\n\n" + markdown(["", "ours", "beside", "ratio"], rows)


def _workers(lines: Sequence[Measurement]) -> str:
    latest = lines[-1]
    rows = [
        [
            f"{run['workers']}, {run['backend']}",
            f"{run['attempts_per_hour']:,}",
            "yes" if run["same"] else "**no**",
        ]
        for run in latest["runs"]
    ]
    what = f"{latest['attempts']} attempts at {latest['task']} in {latest['region']}, {latest['files']} files"
    header = ["workers", "attempts an hour", "every file as with one worker"]
    return f"**The same data whatever the workers**: {what}\n\n" + markdown(header, rows)


def _faults(lines: Sequence[Measurement]) -> str:
    rows = [
        [entry["fault"], str(entry["tried"] or entry["note"]), str(entry["survived"]), str(entry["lost"])]
        for entry in lines[-1]["faults"]
    ]
    title = "**Faults** during generation; survived is what in the end made, byte for byte, the dataset of a calm run"
    return f"{title}\n\n" + markdown(["fault", "tried", "survived", "lost"], rows)


def _fuzzing(lines: Sequence[Measurement]) -> str:
    latest = lines[-1]
    row = [f"{latest['executions']:,}", f"{latest['seconds']} s", "one" if latest["broke"] else "none"]
    return "**Loaders under a fuzzer**\n\n" + markdown(["inputs", "time", "broke a loader"], [row])


_LINT = {
    "success by random commands": "succeed",
    "MuJoCo warning, NaN or speed": "warnings of MuJoCo, NaN",
    "depth in these worlds": "lasting depth [mm]",
    "depth at impacts in these worlds": "depth at impacts [mm]",
    "replays: success": "replays that succeed",
    "replays: MuJoCo warning, NaN or speed": "their warnings, NaN",
    "replays: depth": "their depth [mm]",
}


def _lint(lines: Sequence[Measurement]) -> str:
    rows = []
    for line in newest(lines, "task"):
        numbers = {name: f"{line['found'][name]:g}" for name in _LINT}
        numbers["replays: success"] = f"{100 * line['found']['replays: success']:g} %"
        verdict = ", ".join(line["failed"]) or "pass"
        made_at = line.commit + measured_age(line)
        rows.append([line["task"], str(line["num_episodes"]), *numbers.values(), verdict, made_at])
    header = ["task", "worlds, replays", *_LINT.values(), "checks", "commit"]
    title = "**Tasks under random commands**, and replays of their demonstrations from other starts"
    return f"{title}\n\n" + markdown(header, rows)


MEASURED: tuple[tuple[str, str, Callable[[Sequence[Measurement]], str]], ...] = (
    ("lint.jsonl", "Checks of the tasks", _lint),
    ("variation.jsonl", "Worlds that vary", variation_table),
    ("varied_speed.jsonl", "Speed in worlds that vary", _varied_speed),
    ("feedback.jsonl", "What the closed loop is worth", feedback_table),
    ("tracking.jsonl", "Seen objects", tracking_table),
    ("perception.jsonl", "Fitted errors of seen objects", fit_table),
    ("perception_curves.jsonl", "Policies whose eyes err", curves_table),
    ("generation_time.jsonl", "Time of generation", _time),
    ("controller.jsonl", "Whole-body controller", followed),
    ("controller_pairs.jsonl", "Controllers in pairs", pairs),
    ("robustness.jsonl", "Robustness of the controller", robustness),
    ("speed.jsonl", "Speed", _speed),
    ("workers.jsonl", "Workers", _workers),
    ("faults.jsonl", "Faults", _faults),
    ("fuzzing.jsonl", "Fuzzing", _fuzzing),
)
"""File, heading and what makes the table, in the order of the page."""
