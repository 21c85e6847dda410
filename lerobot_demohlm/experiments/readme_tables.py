"""Measured results, one JSON line each in ``results/``, -> ``docs/results.md`` and the table of the README.

A line says what was measured, by which command, at which commit. Tables are made from lines alone; nothing is typed in.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.experiments import paper
from lerobot_demohlm.experiments.lines import (
    GenerationResult,
    Measurement,
    Result,
    read_generation,
    read_measurements,
    read_policies,
)
from lerobot_demohlm.experiments.plan import DEFAULT_VARIANT, stamp
from lerobot_demohlm.experiments.tables import (
    EARLIER,
    age,
    experiments_tables,
    group,
    latest,
    markdown,
    number,
    rate,
    regions_table,
    share,
)
from lerobot_demohlm.policies.presets import POLICIES

BEGIN, END = "<!-- results -->", "<!-- /results -->"
README_EPISODES = 1000  # training episodes of the policies in the README's table

CAVEATS = """\
These numbers come from a simulation that is kinder than a laboratory. Read them with this in mind.

- **Less turning than the regions suggest.** R3 turns objects by up to 180 degrees. But the objects of six tasks look
  the same after a quarter turn, three tasks limit the turn to 45 degrees because a door, a cart and a board have a
  front, and the vessels of PourWater are round. So no task asks for more than 45 degrees, and R2 and R3 add no
  turning to R1.
- **Exact poses.** Policies and the generator read the pose of every object without error, without delay, and also
  where the head camera could not see the object.
- **No noise and no variation in the world.** Mass, size, friction, motors and the robot's posture at the start are the
  same in every episode, and sensors have no noise. Only the commands in training data carry noise.
- **Shared starts.** The regions of a task are sampled from the same random numbers, so the thirty cells of the table
  by region have 500 different starts, not 15,000. The generator was tuned on the same seed. Policies are scored from
  starts that generation never uses.
- **Scripted demonstrations.** The one demonstration of each task was recorded by a script, not by a person.
- **Friendly scenes.** Nothing lies around the objects, and the feet of pedestals do not collide.
- **A generator that reacts.** It steers the hands, checks grips and may walk to the object up to four times; the
  paper's generator replays without looking.
- **Not the paper's conditions.** The paper's numbers stand beside ours for orientation. Its simulator, robot model,
  controller and demonstrations are others.

Small probes show the edge. With poses that are wrong by 2 cm the generator succeeds in 11 of 16 attempts at
GraspCube. A LiftBox policy with poses that are wrong by 1 cm and 3 degrees and 0.2 s late succeeds in 11 of 16
rollouts in R1. The robot lifts a box of 2 kg in 8 of 8 attempts and a box of 3 kg in none of 16. These probes were
made once, at commit 7873156, by a script that is not part of this repository.
"""


def _latest[R: Result](lines: Iterable[R], *keys: str) -> list[R]:
    """Keep the last line of each combination of keys, in the order of the keys' values."""

    def value(line: R, key: str) -> Any:  # noqa: ANN401
        return line.get(key) if isinstance(line, Measurement) else getattr(line, key)

    kept = {tuple(str(value(line, key)) for key in keys): line for line in lines}
    return [kept[key] for key in sorted(kept)]


def _generation(lines: Sequence[GenerationResult]) -> str:
    rows = []
    for line in _latest(lines, "task", "region", "retries", "command_noise", "start_spread", "stance_spread"):
        failed = ", ".join(f"{name} {count}" for name, count in line.outcomes.items() if name != "success" and count)
        theirs = paper.GENERATION.get((line.task, line.region))
        text = share(line.successes, line.attempts)
        if line.retries:
            text += f", with up to {line.retries} retries"
            if line.first_try_successes is not None:
                text += f"; {100 * line.first_try_successes / line.attempts:.1f} at the first try"
        if line.command_noise:
            text += f", with command noise {line.command_noise:g}"
        if line.start_spread != 1.0:
            text += f", starts {line.start_spread:g} times as wide"
        if line.stance_spread:
            text += f", stances spread by {line.stance_spread:g}"
        rows.append(
            [
                line.task,
                line.region,
                str(line.attempts),
                text,
                f"{theirs}" if theirs else "-",
                failed or "none",
                f"{line.episode_s:.1f}" if line.episode_s else "-",
                line.commit + age(line),
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


def _controller(lines: Sequence[Measurement]) -> str:
    runs = _latest(lines, "peer", "velocity_only")

    def cell(line: Measurement, key: str, unit: str) -> str:
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


def _robustness(lines: Sequence[Measurement]) -> str:
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


def _unstamped(line: Measurement) -> str:
    """Return ", an earlier version" for a measurement of a task that generation has changed since, or may have."""
    return "" if line.get("stamp") == stamp(line["task"]) else EARLIER


def _time(lines: Sequence[Measurement]) -> str:
    rows = [
        [
            line["task"] + _unstamped(line),
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
    for line in _latest(lines, "task"):
        numbers = {name: f"{line['found'][name]:g}" for name in _LINT}
        numbers["replays: success"] = f"{100 * line['found']['replays: success']:g} %"
        verdict = ", ".join(line["failed"]) or "pass"
        made_at = line.commit + _unstamped(line)
        rows.append([line["task"], str(line["num_episodes"]), *numbers.values(), verdict, made_at])
    header = ["task", "worlds, replays", *_LINT.values(), "checks", "commit"]
    title = "**Tasks under random commands**, and replays of their demonstrations from other starts"
    return f"{title}\n\n" + markdown(header, rows)


_MEASURED: tuple[tuple[str, str, Callable[[Sequence[Measurement]], str]], ...] = (
    ("lint.jsonl", "Checks of the tasks", _lint),
    ("generation_time.jsonl", "Time of generation", _time),
    ("controller.jsonl", "Whole-body controller", _controller),
    ("robustness.jsonl", "Robustness of the controller", _robustness),
    ("speed.jsonl", "Speed", _speed),
    ("workers.jsonl", "Workers", _workers),
    ("faults.jsonl", "Faults", _faults),
    ("fuzzing.jsonl", "Fuzzing", _fuzzing),
)
"""File, heading and what makes the table, in the order of the page."""


def tables(results: Path) -> str:
    """Return the Markdown of all results, each with its age and the commands that made it.

    Args:
        results: Folder of JSON lines.

    Raises:
        DatasetError: A line is not what its file holds.
    """
    generation = read_generation(results / "generation.jsonl")
    policies = read_policies(results / "experiments.jsonl")
    parts = []
    if generation:
        text = "\n\n".join(part for part in (regions_table(generation), _generation(generation)) if part)
        parts.append(_section("Generation", text, generation))
    if policies:
        parts.append(_section("Policies", experiments_tables(policies), policies))
    for name, heading, render in _MEASURED:
        lines = read_measurements(results / name)
        if lines:
            parts.append(_section(heading, render(lines), lines))
    return "\n\n".join(parts) or "No results yet."


def _section(heading: str, text: str, lines: Sequence[Result]) -> str:
    """Return a heading, tables, how old they are, and the commands that made them."""
    commits = list(dict.fromkeys(line.commit for line in lines))
    if len(commits) > 3:
        made_at = f"{len(commits)} commits, {commits[0]} to {commits[-1]}"
    else:
        made_at = f"commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}"
    aged = f"*Measured at {made_at}.*"
    if EARLIER in text:
        aged += (
            '\n\n*Rows marked "an earlier version" were measured before the task\'s demonstration, or the code that '
            "generates from it, became what it is now.*"
        )
    commands = "\n".join(dict.fromkeys(line.command for line in lines))
    folded = f"<details><summary>Commands</summary>\n\n```\n{commands}\n```\n\n</details>"
    return f"## {heading}\n\n{text}\n\n{aged}\n\n{folded}"


def results_page(results: Path) -> str:
    """Return ``docs/results.md``: what the numbers do not say, then all tables.

    Args:
        results: Folder of JSON lines.
    """
    intro = (
        "# Results\n\nEvery table on this page is made from the JSON lines in `results/` by\n"
        "`demohlm results --output docs/results.md`. A line keeps its command and its commit; `+` marks a working\n"
        "tree that differed from the commit."
    )
    return f"{intro}\n\n## What these numbers do not say\n\n{CAVEATS}\n{tables(results)}\n"


def readme_table(results: Path) -> str:
    """Return the README's table: success of generation and of each policy in each task, and the paper's.

    Args:
        results: Folder of JSON lines.
    """
    policies = latest(read_policies(results / "experiments.jsonl"), DEFAULT_VARIANT)
    chosen = [
        result
        for result in policies
        if (result.region, result.preset, result.num_train_episodes) == (DEFAULT_REGION, "cpu", README_EPISODES)
    ]
    cells = group(chosen, "task", "policy")
    generated = {
        result.task: result
        for result in read_generation(results / "generation.jsonl")
        if result.is_plain and result.region == DEFAULT_REGION
    }
    rows = []
    for task, theirs in paper.SUCCESS_BY_SIZE.items():
        made = generated.get(task)
        scored = [cells.get((task, policy)) for policy in POLICIES]
        ages = [age(line) for line in (made, *(found[0] for found in scored if found)) if line is not None]
        row = [task + max(ages, default="")]
        row.append("-" if made is None else f"{100 * made.successes / made.attempts:.1f}")
        row += ["-" if not found else f"{100 * rate(found)[0]:.1f}" for found in scored]
        rows.append([*row, number(paper.GENERATION.get((task, DEFAULT_REGION))), number(theirs[-1])])
    attempts = " or ".join(map(str, sorted({made.attempts for made in generated.values()}))) or "no"
    episodes = " or ".join(map(str, sorted({result.episodes for result in chosen}))) or "no"
    header = ["task", "generation", "MLP", "ACT", "Diffusion", "paper: generation", "paper: ACT, 5000 episodes"]
    text = (
        f"Success [%] in R3: {attempts} attempts of generation, and {episodes} rollouts of each policy after "
        f"training on {README_EPISODES} episodes."
    )
    return f"{text}\n\n{markdown(header, rows)}"


def write_results(output: Path, results: Path) -> bool:
    """Write ``docs/results.md`` and return whether it changed.

    Args:
        output: The file; made where it does not exist.
        results: Folder of JSON lines.
    """
    page = results_page(results)
    changed = not output.exists() or output.read_text() != page
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(page)
    return changed


def update_readme(readme: Path, results: Path) -> bool:
    """Put the README's table between its markers and return whether the file changed.

    Args:
        readme: The file.
        results: Folder of JSON lines.

    Raises:
        DatasetError: The markers are missing.
    """
    text = readme.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise DatasetError(
            f"{readme.name} without {BEGIN} and {END}", "both markers", "put them where the table belongs"
        )
    changed = f"{before}{BEGIN}\n{readme_table(results)}\n{END}{after}"
    readme.write_text(changed)
    return changed != text
