"""The whole-body controller -> pictures of it: tracking over time, push survival, learning curve, and a video.

``demohlm benchmark controller --figures docs --run runs/controller`` draws them all. One robot goes through a script of
all commands on the deployment model; what it does is drawn over what it was told, and filmed.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from gym_demohlm import jsonl
from gym_demohlm.control import command
from gym_demohlm.errors import SceneError
from gym_demohlm.timing import CONTROL_DT, STEP_DT
from gym_demohlm.wbc.evaluation.episodes import push_robots, tracked
from gym_demohlm.wbc.evaluation.intervals import wilson
from gym_demohlm.wbc.evaluation.performance import SCRIPT, Recorder, Scene, Take, film, perform
from gym_demohlm.wbc.evaluation.trial import trial_simulation

matplotlib.use("Agg")

PUSH_SPEEDS = tuple(np.round(np.arange(0.1, 1.01, 0.1), 1))  # m/s
_TOLD, _DONE, _WALKS, _STANDS = "#d1495b", "#2e4057", "#00798c", "#edae49"
_RUNS = (_DONE, _TOLD, _WALKS, _STANDS, "#8e6c8a", "#7a9e4f")
_CHANNELS = {  # name in ``tracked`` -> column of the command, axis label
    "forward": (0, "forward [m/s]"),
    "sideways": (1, "sideways [m/s]"),
    "yaw_rate": (2, "yaw rate [rad/s]"),
    "height": (command.HEIGHT, "height [m]"),
    "pitch": (command.PITCH, "torso pitch [rad]"),
    "roll": (command.ROLL, "torso roll [rad]"),
    "yaw": (command.YAW, "torso yaw [rad]"),
}


def draw_tracking(recorder: Recorder, take: Take, path: Path) -> None:
    """Draw what a robot was told and what it did, one row a channel, each over the range of its commands."""
    done: dict[str, list[float]] = {name: [] for name in _CHANNELS}
    for state in take.states:
        recorder.show(state)
        for name, values in tracked(recorder).items():
            done[name].append(float(values[0]))
    seconds = CONTROL_DT * (1 + np.arange(len(take.labels)))
    figure = Figure(figsize=(11, 11), layout="constrained")
    rows = figure.subplots(len(_CHANNELS), 1, sharex=True)
    for axes, (name, (column, label)) in zip(rows, _CHANNELS.items(), strict=True):
        _shade(axes, take.labels)
        axes.plot(seconds, done[name], color=_DONE, linewidth=0.9, label="measured")
        axes.plot(seconds, take.commands[:, column], color=_TOLD, linewidth=1.4, linestyle="--", label="commanded")
        axes.set_ylabel(label, fontsize=9)
        margin = 0.1 * (command.UPPER[column] - command.LOWER[column])
        axes.set_ylim(command.LOWER[column] - margin, command.UPPER[column] + margin)
        axes.margins(x=0)
        axes.grid(alpha=0.3)
    for start, stop, label in _spans(take.labels):
        middle = 0.5 * (start + stop)
        rows[0].text(middle, 1.04, label, rotation=55, fontsize=7.5, transform=rows[0].get_xaxis_transform())
    rows[0].legend(loc="lower right", fontsize=8, ncols=2)
    rows[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=100)


PUSHED = {  # name -> column of the command -> value
    "standing": {},
    "squatting at 0.45 m": {command.HEIGHT: 0.45},
    "walking at 0.4 m/s": {0: 0.4},
}


def push_survival(
    weights: Path | None,
    *,
    num_worlds: int = 24,
    speeds: Sequence[float] = PUSH_SPEEDS,
    seed: int = 0,
    num_threads: int = 2,
) -> dict[str, list[float]]:
    """Push robots once, from a random side, and count who still stands 3 s later.

    Args:
        weights: Of the controller; the packaged ones by default.
        num_worlds: Robots for each speed and each of ``PUSHED``; pushed one after the other over a second, so that
            those who walk are pushed in all phases of their gait.
        speeds: Of the pushes [m/s].
        seed: Of the pushes.
        num_threads: Threads of the physics.

    Returns:
        For each of ``PUSHED`` the share that stands, one number a speed.
    """
    rng = np.random.default_rng(seed)
    simulation = trial_simulation(len(PUSHED) * len(speeds) * num_worlds, num_threads=num_threads, weights=weights)
    shape = (len(PUSHED), len(speeds), num_worlds)
    commands = np.tile(command.rest(), (*shape, 1))
    for index, told in enumerate(PUSHED.values()):
        commands[index][..., list(told)] = list(told.values())
    commands = commands.reshape(-1, command.SIZE)
    speed = np.broadcast_to(np.asarray(speeds)[:, None], shape).ravel()
    first, spread, after = (round(span / STEP_DT) for span in (2.0, 1.0, 3.0))
    pushed_at = first + np.broadcast_to(np.arange(num_worlds) % spread, shape).ravel()
    alive = np.ones(len(commands), dtype=bool)
    for step in range(first + spread + after):
        if (pushed_at == step).any():
            push_robots(simulation, np.where(pushed_at == step, speed, 0.0), rng)
        alive &= ~simulation.step(commands, active=alive & (step < pushed_at + after)).unstable
        alive &= ~simulation.fallen()
    simulation.close()
    return dict(zip(PUSHED, alive.reshape(shape).mean(axis=2).tolist(), strict=True))


def draw_push_survival(found: Mapping[str, Sequence[float]], num_worlds: int, path: Path) -> None:
    """Draw the share of robots that a push does not fell over its speed, with 95 % Wilson intervals.

    Args:
        found: From ``push_survival`` with ``PUSH_SPEEDS``.
        num_worlds: Robots behind each number.
        path: A ``.png`` file.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    apart = 0.012  # m/s, so that intervals do not hide one another
    for index, ((name, shares), color) in enumerate(zip(found.items(), (_STANDS, _TOLD, _WALKS), strict=True)):
        share = np.asarray(shares)
        low, high = wilson(share, num_worlds)
        axes.errorbar(
            np.array(PUSH_SPEEDS) + apart * (index - 1),
            100 * share,
            100 * np.clip([share - low, high - share], 0.0, 1.0),
            fmt="o-",
            markersize=4,
            linewidth=1.3,
            elinewidth=0.8,
            color=color,
            label=name,
        )
    axes.set(xlabel="push: sudden velocity of the base, random direction [m/s]", ylabel="still up 3 s later [%]")
    axes.set_ylim(-3, 103)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    figure.savefig(path, dpi=110)


def draw_learning(run: Path, path: Path) -> None:
    """Draw how a training run went, over steps and over minutes.

    Args:
        run: Its folder: ``log.jsonl`` is of the training worlds, ``evaluation.jsonl`` of the deployment model.
        path: A ``.png`` file.

    Raises:
        SceneError: The folder holds no log.
    """
    log, evaluation = _read_lines(run / "log.jsonl"), _read_lines(run / "evaluation.jsonl")
    if not log:
        raise SceneError(f"no log.jsonl in {run}", "the folder of a training run", "give the --output of the training")
    figure = Figure(figsize=(11, 7), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    velocity = np.hypot(_column(log, "error/walk_vx"), _column(log, "error/walk_vy"))
    panels: tuple[tuple[Axes, str, dict[str, np.ndarray], dict[str, str]], ...] = (
        (
            grid[0, 0],
            "walking: error [m/s, rad/s]",
            {"velocity": velocity, "yaw rate": _column(log, "error/walk_yaw_rate")},
            {"velocity": "walking/linear_velocity", "yaw rate": "walking/yaw_rate"},
        ),
        (
            grid[0, 1],
            "standing: error [m, rad]",
            {name: _column(log, f"error/stand_{name}") for name in ("height", "pitch", "roll", "yaw")},
            {
                "height": "standing/height",
                "pitch": "standing/torso_pitch",
                "roll": "standing/torso_roll",
                "yaw": "standing/torso_yaw",
            },
        ),
        (
            grid[1, 0],
            "time between falls in training [s]",
            {
                "left alone": CONTROL_DT * _column(log, "ticks_between_falls"),
                "pushed": CONTROL_DT * _column(log, "ticks_between_falls_pushed"),
            },
            {},
        ),
        (
            grid[1, 1],
            "curricula, survival of 8 s",
            {"command range": _column(log, "level"), "push strength": _column(log, "push_level")},
            {"survival": "survival", "survival, pushed": "survival_pushed"},
        ),
    )
    steps, minutes = _column(log, "steps") / 1e6, _column(log, "seconds") / 60
    measured_at = _column(evaluation, "steps") / 1e6
    colors = (_DONE, _TOLD, _WALKS, _STANDS)
    for axes, title, lines, points in panels:
        names = list(dict.fromkeys([*lines, *points]))
        for name, color in zip(names, colors, strict=False):
            if name in lines:
                axes.plot(steps, lines[name], color=color, linewidth=1.2, label=name)
            if name in points and evaluation:
                measured = _column(evaluation, f"deployment/{points[name]}")
                label = None if name in lines else name
                axes.plot(measured_at, measured, "o", color=color, markersize=4, label=label)
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlim(0.0, steps[-1])
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    for axes in (*grid[0], grid[1, 0]):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    for axes in grid[1]:
        axes.set_xlabel("control steps [million]")
    for axes in grid[0]:
        # From nothing, and past the end, so that the axes' own margins have minutes too.
        of_steps, of_minutes = (np.concatenate([[0.0], values, 2 * values[-1:]]) for values in (steps, minutes))
        above = axes.secondary_xaxis(
            "top",
            functions=(
                lambda x, a=of_steps, b=of_minutes: np.interp(x, a, b),
                lambda x, a=of_steps, b=of_minutes: np.interp(x, b, a),
            ),
        )
        above.set_xlabel("minutes", fontsize=9)
        axes.set_title(axes.get_title(loc="left"), fontsize=10, loc="left", y=1.16)
    figure.suptitle("lines: training worlds, with exploration and noise; dots: deployment model", fontsize=9)
    figure.savefig(path, dpi=100)


def draw_comparison(runs: Sequence[Path], path: Path) -> None:
    """Draw training runs over one another, as the deployment model sees them, one colour a run.

    Args:
        runs: Their folders, whose names are the labels; as many as there are colours.
        path: A ``.png`` file.

    Raises:
        SceneError: More runs than that, or a folder that holds no evaluations.
    """
    if len(runs) > len(_RUNS):
        raise SceneError(f"{len(runs)} runs", f"at most {len(_RUNS)}, one colour each", "draw several figures")
    panels = {
        "survival": "no fall in 8 s [%]",
        "walking/linear_velocity": "velocity error, walking [m/s]",
        "standing/torso_pitch": "torso pitch error, standing [rad]",
    }
    figure = Figure(figsize=(12, 4), layout="constrained")
    grid = figure.subplots(1, len(panels))
    for run, color in zip(runs, _RUNS[: len(runs)], strict=True):
        lines = _read_lines(run / "evaluation.jsonl")
        if not lines:
            got = f"no evaluation.jsonl in {run}"
            raise SceneError(got, "the folder of a training run", "train with --evaluate-every")
        steps = _column(lines, "steps") / 1e6
        for axes, name in zip(grid, panels, strict=True):
            values = _column(lines, f"deployment/{name}")
            # An error of nothing is that of robots that all fell before anything was measured.
            values = 100 * values if name == "survival" else np.where(values == 0.0, np.nan, values)
            axes.plot(steps, values, "o-", color=color, markersize=3, linewidth=1.2, label=run.name.replace("_", " "))
    for axes, label in zip(grid, panels.values(), strict=True):
        axes.set(xlabel="control steps [million]", ylabel=label)
        axes.grid(alpha=0.3)
    grid[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def draw(
    folder: Path,
    weights: Path | None = None,
    run: Path | None = None,
    seed: int = 0,
    num_threads: int = 2,
    *,
    script: Sequence[Scene] = SCRIPT,
    num_pushed: int = 24,
) -> dict[str, Any]:
    """Draw all figures into a folder and return their names, with the numbers behind the push-survival curve.

    Args:
        folder: Made where absent.
        weights: Of the controller; the packaged ones by default.
        run: Folder of a training run; no learning curve without.
        seed: Of the pushes.
        num_threads: Threads of the physics.
        script: What one robot goes through.
        num_pushed: Robots behind each point of the push-survival curve.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"controller_{name}" for name in ("tracking.png", "pushes.png", "commands.mp4")}
    recorder = Recorder(weights)
    take = perform(recorder, script)
    draw_tracking(recorder, take, paths["tracking.png"])
    pushes = push_survival(weights, num_worlds=num_pushed, seed=seed, num_threads=num_threads)
    draw_push_survival(pushes, num_pushed, paths["pushes.png"])
    drawn = list(paths.values())
    if run is not None:
        drawn.append(folder / "controller_learning.png")
        draw_learning(run, drawn[-1])
    film(recorder, take, paths["commands.mp4"])  # last: it takes longest
    return {
        "figures": [path.name for path in drawn],
        "fell": take.fell,
        "seconds": len(take.labels) * CONTROL_DT,
        "push_speeds": list(PUSH_SPEEDS),
        "push_survival": pushes,
        "robots_a_point": num_pushed,
    }


def _spans(labels: Sequence[str]) -> list[tuple[float, float, str]]:
    """Return start and end [s] of each stretch with one label."""
    changes = [index for index in range(1, len(labels)) if labels[index] != labels[index - 1]]
    edges = [0, *changes, len(labels)]
    return [(a * CONTROL_DT, b * CONTROL_DT, labels[a]) for a, b in pairwise(edges)]


def _shade(axes: Axes, labels: Sequence[str]) -> None:
    for index, (start, stop, _) in enumerate(_spans(labels)):
        if index % 2:
            axes.axvspan(start, stop, color="0.94", linewidth=0)


def _read_lines(path: Path) -> list[dict[str, float]]:
    return jsonl.read(path) if path.exists() else []


def _column(lines: Sequence[Mapping[str, float]], name: str) -> np.ndarray:
    """Return one number of every line, NaN where a line lacks it."""
    return np.array([line.get(name, np.nan) for line in lines])
