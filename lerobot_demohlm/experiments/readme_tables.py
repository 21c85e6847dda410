"""Measured results, one JSON line each in ``results/``, -> the tables of the README.

A line says what was measured, by which command, at which commit. Tables are made from lines alone; nothing is typed in.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.experiments.lines import Line, read
from lerobot_demohlm.experiments.paper import GENERATION
from lerobot_demohlm.experiments.tables import age, experiments_tables, markdown, regions_table, share

BEGIN, END = "<!-- results -->", "<!-- /results -->"


def _latest(lines: list[Line], *keys: str) -> list[Line]:
    """Keep the last line of each combination of keys, in the order of the keys' values."""
    kept = {tuple(str(line.get(key)) for key in keys): line for line in lines}
    return [kept[key] for key in sorted(kept)]


def _generation(lines: list[Line]) -> str:
    rows = []
    plain = PLAIN.content()
    for line in _latest([{**plain, **line} for line in lines], "task", "region", *plain):
        failed = ", ".join(f"{name} {count}" for name, count in line["outcomes"].items() if name != "success" and count)
        paper = GENERATION.get((line["task"], line["region"]))
        rate = share(line["successes"], line["attempts"])
        if line["retries"]:
            first = f"{100 * line['first_try_successes'] / line['attempts']:.1f}"
            rate += f", with up to {line['retries']} retries; {first} at the first try"
        if line["command_noise"]:
            rate += f", with command noise {line['command_noise']:g}"
        if line["start_spread"] != 1.0:
            rate += f", starts {line['start_spread']:g} times as wide"
        if line["stance_spread"]:
            rate += f", stances spread by {line['stance_spread']:g}"
        rows.append(
            [
                line["task"],
                line["region"],
                str(line["attempts"]),
                rate,
                f"{paper}" if paper else "-",
                failed or "none",
                f"{line['episode_s']:.1f}" if line.get("episode_s") else "-",
                line["commit"] + age(line),
            ]
        )
    header = ["task", "region", "attempts", "success % (95 % interval)", "paper %"]
    header += ["failures", "s an episode", "commit"]
    return "**Generation**, every attempt counted\n\n" + markdown(header, rows)


_CONTROLLER = (
    ("linear_velocity_error", "linear velocity error, walking, instantaneous", "m/s", "0.142"),
    ("yaw_rate_error", "yaw rate error, walking, instantaneous", "rad/s", "0.154"),
    ("height_error", "height error, standing", "m", "0.028"),
    ("torso_pitch_error", "torso pitch error, standing", "rad", "0.049"),
    ("torso_roll_error", "torso roll error, standing", "rad", "0.016"),
    ("torso_yaw_error", "torso yaw error, standing", "rad", "0.013"),
    ("standing_drift", "speed when told to stand", "m/s", "-"),
    ("walking_slip", "slip of the soles that bear load, walking", "m/s", "-"),
    ("walking_power", "mechanical power, walking", "W", "-"),
)
_DISTURBANCES = {
    "none": "none",
    "friction_0.4": "friction 0.4",
    "torso_3kg": "3 kg on the torso",
    "delay_20ms": "joint targets 20 ms late",
    "timestep_1ms": "physics at 1 ms",
}


def _controller(lines: list[Line]) -> str:
    runs = _latest(lines, "peer", "velocity_only")

    def cell(line: Line, key: str, unit: str) -> str:
        return "-" if line.get(key) is None else f"{line[key]:.3g} {unit}" if unit == "W" else f"{line[key]:.3f} {unit}"

    rows = [
        [name, *(cell(line, key, unit) for line in runs), best if best == "-" else f"{best} {unit}"]
        for key, name, unit, best in _CONTROLLER
    ]
    for key, name in (("survival", "no fall in an episode"), ("survival_pushed", "the same, pushed")):
        rows.append([name, *(f"{100 * line[key]:.1f} %" for line in runs), "-"])
    columns = [
        (line.get("peer") or "ours") + (", velocity commands only" if line.get("velocity_only") else "")
        for line in runs
    ]
    first = runs[0]
    note = (
        f"\n\n{first['num_worlds']} robots for {first['seconds']:.0f} s each, random commands over the whole range, "
        f"redrawn every 4 s, arms moving, 0 to {first.get('largest_hand_load', 0):.0f} kg in each hand; pushes are "
        "0.5 m/s every 3 s. Published errors are those of HTD and AMO in their own protocols."
    )
    for line in runs:
        if line.get("velocity_only"):
            load = line.get("largest_hand_load")
            hands = f"0 to {load:g} kg in each hand" if load else "empty hands"
            note += f" Velocity commands only: {line['num_worlds']} robots, upright, arms still, {hands}."
        if line.get("peer"):
            note += f" {line['peer']}: {line['peer_file']}, {line['num_worlds']} robots, velocity commands only."
    return "**Whole-body controller**\n\n" + markdown(["", *columns, "best published"], rows) + note


def _robustness(lines: list[Line]) -> str:
    latest = lines[-1]
    rows = [[text, f"{100 * latest[f'survival/{name}']:.1f} %"] for name, text in _DISTURBANCES.items()]
    header = ["disturbance", f"no fall in {latest['seconds']:.0f} s ({latest['num_worlds']} robots each, empty hands)"]
    return "**Whole-body controller outside its training**\n\n" + markdown(header, rows)


_SHARES = {
    "mj_step": "`mj_step`",
    "controller": "controller",
    "inverse_kinematics": "inverse kinematics",
    "writing": "writing",
    "python": "the rest",
}


def _time(lines: list[Line]) -> str:
    rows = [
        [
            line["task"],
            line["region"],
            f"{line['successes']} of {line['attempts']}",
            f"{line['seconds_per_episode']:.2f} s",
            f"{line['simulated_s_per_episode']:.1f} s",
            *(f"{100 * line[f'{name}_share']:.0f} %" for name in _SHARES),
        ]
        for line in _latest(lines, "task", "region")
    ]
    header = ["task", "region", "succeeded", "CPU time an episode", "simulated"]
    header += [f"in {of}" for of in _SHARES.values()]
    return "**Time to generate**, and where it goes\n\n" + markdown(header, rows)


def _rate(ours: str, theirs: str, ratio: str) -> Callable[[Line], tuple[str, str, str]]:
    """Return what picks a rate, the one beside it and their ratio from a line."""
    return lambda line: (f"{line[ours]:,}", f"{line[theirs]:,}", f"{line[ratio]:g}")


_SPEED: dict[str, tuple[str, str, Callable[[Line], tuple[str, str, str]]]] = {
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
        "samples loaded a second (chunk 20, batch 512)",
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


def _speed(lines: list[Line]) -> str:
    latest = {(line["benchmark"], line.get("lerobot_worlds"), line.get("policy")): line for line in lines}
    rows = []
    for (name, *_), line in sorted(latest.items(), key=lambda entry: list(_SPEED).index(entry[0][0])):
        what, beside, pick = _SPEED[name]
        ours, theirs, ratio = pick(line)
        rows.append([what.format(**line), ours, f"{theirs} ({beside.format(**line)})", ratio])
    return "**Speed**, both measured in one run\n\n" + markdown(["", "ours", "beside", "ratio"], rows)


def _workers(lines: list[Line]) -> str:
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


def _faults(lines: list[Line]) -> str:
    rows = [
        [entry["fault"], str(entry["tried"] or entry["note"]), str(entry["survived"]), str(entry["lost"])]
        for entry in lines[-1]["faults"]
    ]
    title = "**Faults** during generation; survived is what in the end made, byte for byte, the dataset of a calm run"
    return f"{title}\n\n" + markdown(["fault", "tried", "survived", "lost"], rows)


def _fuzzing(lines: list[Line]) -> str:
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


def _lint(lines: list[Line]) -> str:
    rows = []
    for line in _latest(lines, "task"):
        numbers = {name: f"{line['found'][name]:g}" for name in _LINT}
        numbers["replays: success"] = f"{100 * line['found']['replays: success']:g} %"
        verdict = ", ".join(line["failed"]) or "pass"
        made_at = line["commit"] + age(line)
        rows.append([line["task"], str(line["num_episodes"]), *numbers.values(), verdict, made_at])
    header = ["task", "worlds, replays", *_LINT.values(), "checks", "commit"]
    title = "**Tasks under random commands**, and replays of their demonstrations from other starts"
    return f"{title}\n\n" + markdown(header, rows)


_SECTIONS = (
    ("generation.jsonl", _generation),
    ("generation.jsonl", regions_table),
    ("lint.jsonl", _lint),
    ("generation_time.jsonl", _time),
    ("experiments.jsonl", experiments_tables),
    ("controller.jsonl", _controller),
    ("robustness.jsonl", _robustness),
    ("speed.jsonl", _speed),
    ("workers.jsonl", _workers),
    ("faults.jsonl", _faults),
    ("fuzzing.jsonl", _fuzzing),
)


def tables(results: Path) -> str:
    """Return the Markdown of all results, each with the commands that made it."""
    parts, shown = [], set()
    for name, render in _SECTIONS:
        lines = read(results / name)
        if lines and (table := render(lines)):
            if name in shown:  # its commands stand above
                parts.append(table)
                continue
            shown.add(name)
            commands = "\n".join(dict.fromkeys(f"{line['command']}" for line in lines))
            parts.append(f"{table}\n\n```\n{commands}\n```")
    return "\n\n".join(parts) or "No results yet."


def update_readme(readme: Path, results: Path) -> bool:
    """Put the tables between the README's markers; returns whether it changed.

    Raises:
        DatasetError: The markers are missing.
    """
    text = readme.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise DatasetError(f"{readme.name} without {BEGIN} and {END}", "both markers", "put them where tables belong")
    changed = f"{before}{BEGIN}\n{tables(results)}\n{END}{after}"
    readme.write_text(changed)
    return changed != text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm results``."""
    parser.add_argument("--results", type=Path, default=Path("results"), help="folder of JSON lines")
    parser.add_argument("--readme", type=Path, help="put the tables into this file instead of printing them")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm results``."""
    if arguments.readme is None:
        print(tables(arguments.results))
    elif update_readme(arguments.readme, arguments.results):
        print(f"updated {arguments.readme}")
