"""A task -> a table of checks of what it calls success and failure, what a policy sees, and what its physics does.

A success condition must be false at every reset, out of reach of a robot that stands still or gets random commands,
and last in the task's demonstration. The same episodes, and the demonstration's replay, are watched for MuJoCo's
warnings, for numbers that are not finite or never change, and for things that sink into one another.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from gym_demohlm import observation
from gym_demohlm.control import command
from gym_demohlm.episode import HOLD_S, HOLD_STEPS, max_episode_steps
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.robot.robot import GRIPPER_JOINTS
from gym_demohlm.simulation import STEP_DT, Simulation
from gym_demohlm.task import Task, all_tasks, get_task
from lerobot_demohlm.demonstration import Demonstration, load

ALL = "all"
MAX_DEPTH = 0.005  # m that one thing may be inside another
LEAST_CHANGE = 1e-6  # of a number of the observation over all starts and steps; below it is rounding
PERIODS = (1, 10)  # steps after which a random command is followed by the next, in turn from world to world


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How thoroughly a task is checked.

    Attributes:
        num_resets: Starts that are looked at, spread evenly over the task's regions.
        num_still: Worlds whose robot stands still for the time limit, regions in turn.
        num_random: Worlds whose robot gets uniformly random commands for the time limit, regions in turn.
        seed: Of the starts and the commands.
        time_limit_s: How long those worlds run [s]; None: for the task's own time limit.
    """

    num_resets: int = 102
    num_still: int = 3
    num_random: int = 12
    seed: int = 0
    time_limit_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("num_resets", "num_still", "num_random"):
            if getattr(self, name) < 1:
                raise DemoHLMError(f"{name}={getattr(self, name)}", "at least 1", "raise it")
        if self.time_limit_s is not None and not self.time_limit_s > 0:
            raise DemoHLMError(f"time_limit_s={self.time_limit_s}", "more than 0 s", "raise it")
        if self.seed < 0:
            raise DemoHLMError(f"seed={self.seed}", "a seed of at least 0", "raise it")


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the table.

    Attributes:
        name: What is checked.
        got: What was found.
        expected: What should have been found.
        ok: Whether that is so.
    """

    name: str
    got: str
    expected: str
    ok: bool


class _Watched(Simulation):
    """A simulation that keeps the deepest contact of anything that the task added, looked for at every tick.

    Attributes:
        depth: The deepest so far [m].
        deepest: Names of what was inside each other, and when.
    """

    def __init__(self, task: Task, num_worlds: int = 1) -> None:
        self.depth, self.deepest = 0.0, "no contact"
        super().__init__(task, num_worlds)
        model = self.model
        robot = model.body_rootid[model.body("pelvis").id]
        # Robot and floor alone are the controller's matter; a contact counts where a task's body takes part.
        self._added = model.body_rootid[model.geom_bodyid] != robot
        self._added[model.geom("floor").id] = False

    def watch(self, worlds: np.ndarray) -> None:
        """Look at the contacts of some worlds now."""
        for world in worlds:
            contacts = self.mj_data(int(world)).contact
            if len(contacts.dist) == 0:
                continue
            depths = np.where(self._added[contacts.geom].any(axis=1), -contacts.dist, 0.0)
            index = int(np.argmax(depths))
            if depths[index] > self.depth:
                self.depth = float(depths[index])
                names = " in ".join(self._name(geom) for geom in contacts.geom[index])
                self.deepest = f"{names} at {self.time[world]:.2f} s in world {world}"

    def _tick(self, tick: int, rows: np.ndarray, commands: np.ndarray) -> np.ndarray:
        sound = super()._tick(tick, rows, commands)
        self.watch(sound)
        return sound

    def _name(self, geom: int) -> str:
        return self.model.geom(geom).name or self.model.body(self.model.geom_bodyid[geom]).name


def lint(task: Task, demonstration: Demonstration | None, settings: Settings | None = None) -> list[Check]:
    """Check a task.

    Args:
        task: The task.
        demonstration: Of this task, to be replayed; None leaves those checks out.
        settings: The defaults if not given.

    Returns:
        The checks in the order of the table; ``Check.name`` says which is which.
    """
    settings = settings or Settings()
    checks = [*_check_resets(task, settings), *_check_episodes(task, settings)]
    if demonstration is not None:
        checks += _check_demonstration(task, demonstration)
    return checks


def _check_resets(task: Task, settings: Settings) -> list[Check]:
    generators = {name: np.random.default_rng([settings.seed, index]) for index, name in enumerate(task.regions)}
    regions = _regions(task, settings.num_resets)
    sim = _Watched(task, settings.num_resets)
    sim.reset([task.sample(region, generators[region]) for region in regions])
    sim.watch(np.arange(settings.num_resets))
    where = f"{settings.num_resets} resets in {', '.join(task.regions)}"
    checks = [
        _never("success at a reset", sim.success(), where),
        _never("failure at a reset", _any_failure(sim), where),
        _depth_check("depth at a reset", sim),
    ]
    sim.close()
    return checks


def _check_episodes(task: Task, settings: Settings) -> list[Check]:
    """Run the worlds that stand still and, after them, those with random commands, together.

    A world whose robot falls, or whose physics breaks down, starts again elsewhere, so that each runs for the whole
    time limit.
    """
    num_still, num_worlds = settings.num_still, settings.num_still + settings.num_random
    generators = [np.random.default_rng([settings.seed, 100, world]) for world in range(num_worlds)]
    regions = [*_regions(task, num_still), *_regions(task, settings.num_random)]
    sim = _Watched(task, num_worlds)
    commands = np.tile(command.rest(), (num_worlds, 1))
    success, failure, broken, falls = (np.zeros(num_worlds, dtype=int) for _ in range(4))
    restart, seen = np.arange(num_worlds), []
    limit_s = settings.time_limit_s
    num_steps = max_episode_steps(task) if limit_s is None else max(1, round(limit_s / STEP_DT))
    for step in range(num_steps):
        if len(restart):
            sim.reset([task.sample(regions[world], generators[world]) for world in restart], restart)
        for index, world in enumerate(range(num_still, num_worlds)):
            if step % PERIODS[index % len(PERIODS)] == 0:
                commands[world] = generators[world].uniform(command.LOWER, command.UPPER)
        sim.step(commands)
        success += sim.success() & ~sim.unstable
        failure += _any_failure(sim) & ~sim.unstable
        broken += sim.unstable
        falls += sim.fallen() & ~sim.unstable
        restart = np.flatnonzero(sim.fallen() | sim.unstable)
        seen.append(_observe(sim))
    sim.close()
    still, moved = slice(0, num_still), slice(num_still, None)
    standing = f"{num_still} worlds of {num_steps * STEP_DT:g} s, {falls[still].sum()} falls"
    random = f"{settings.num_random} worlds of {num_steps * STEP_DT:g} s, {falls[moved].sum()} falls"
    return [
        _never("success standing still", success[still], standing),
        _never("failure standing still", failure[still], standing),
        _never("success by random commands", success[moved], random),
        *_check_observations(task, np.stack(seen)),
        _never("MuJoCo warning, NaN or speed", broken, f"{num_worlds} worlds"),
        _depth_check("depth in these worlds", sim),
    ]


def _check_observations(task: Task, seen: np.ndarray) -> list[Check]:
    """Check the observations (steps, N, numbers)."""
    names = np.array([*observation.STATE_NAMES, *observation.environment_names(task)])
    numbers = seen.reshape(-1, seen.shape[-1])
    infinite = names[~np.isfinite(numbers).all(axis=0)]
    constant = set(names[np.ptp(numbers, axis=0) < LEAST_CHANGE])
    if task.hands == "rubber":  # a hand without a gripper has its place in the observation all the same
        constant -= {f"{joint}.{kind}" for joint in GRIPPER_JOINTS for kind in ("pos", "vel")}
    return [
        Check(name="observation finite", got=_listed(infinite), expected="none that is not", ok=len(infinite) == 0),
        Check(name="observation changes", got=_listed(constant), expected="none that never does", ok=not constant),
    ]


def _check_demonstration(task: Task, demonstration: Demonstration) -> list[Check]:
    sim = _Watched(task)
    sim.restore(demonstration.start)
    sim.watch(np.arange(1))
    success, failure = [], []
    for action in demonstration.action:
        sim.step(action[None].astype(np.float64))
        success.append(bool(sim.success()[0]))
        failure.append(bool(_any_failure(sim)[0]))
    runs = _run_lengths(success)
    longest = max(runs, default=0)
    spans = ", ".join(f"{length * STEP_DT:.1f} s" for length in runs) or "never"
    checks = [
        Check(name="demonstration: success ever", got=spans, expected="once or more", ok=longest > 0),
        Check(
            name="demonstration: success at the end",
            got="yes" if success[-1] else "no",
            expected="yes",
            ok=success[-1],
        ),
        Check(
            name="demonstration: success held",
            got=f"{longest * STEP_DT:.1f} s",
            expected=f"{HOLD_S:.1f} s or more",
            ok=longest >= HOLD_STEPS,
        ),
        _never("demonstration: failure", np.array(failure), f"{len(failure)} steps"),
        _never("demonstration: MuJoCo warning, NaN or speed", sim.unstable, "1 replay"),
        _depth_check("demonstration: depth", sim),
    ]
    sim.close()
    return checks


def _observe(sim: Simulation) -> np.ndarray:
    """Return all numbers that a policy sees without a camera (N, numbers)."""
    return np.concatenate([observation.agent_pos(sim), observation.environment_state(sim)], axis=1)


def _any_failure(sim: Simulation) -> np.ndarray:
    return np.any([np.zeros(sim.num_worlds, dtype=bool), *sim.failures().values()], axis=0)


def _regions(task: Task, count: int) -> list[str]:
    """Return so many names of the task's regions, in turn."""
    names = list(task.regions)
    return [names[index % len(names)] for index in range(count)]


def _run_lengths(values: Sequence[bool]) -> list[int]:
    """Return how long each unbroken run of True is, in order."""
    edges = np.flatnonzero(np.diff([0, *map(int, values), 0]))
    return [int(stop - start) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def _never(name: str, found: np.ndarray, where: str) -> Check:
    count = int(np.count_nonzero(found))
    return Check(name=name, got=f"{count} in {where}", expected="0", ok=count == 0)


def _depth_check(name: str, sim: _Watched) -> Check:
    got = f"{1000 * sim.depth:.1f} mm" + (f", {sim.deepest}" if sim.depth > MAX_DEPTH else "")
    return Check(name=name, got=got, expected=f"{1000 * MAX_DEPTH:g} mm or less", ok=sim.depth <= MAX_DEPTH)


def _listed(names: set[str] | np.ndarray) -> str:
    return ", ".join(sorted(map(str, names))) or "none"


def format_table(title: str, checks: Sequence[Check]) -> str:
    """Return the checks as lines of text in four columns: check, got, expected, ok."""
    rows = [("check", "got", "expected", "ok")]
    rows += [(check.name, check.got, check.expected, "yes" if check.ok else "NO") for check in checks]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]) for row in rows
    ]
    return "\n".join([title, *lines])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm lint-task``."""
    defaults = Settings()
    parser.add_argument("task", help=f"name of the task, such as LiftBox, or {ALL!r}")
    parser.add_argument("--root", type=Path, help="directory of the demonstration (default: the packaged one)")
    parser.add_argument("--no-demonstration", action="store_true", help="leave out what needs a demonstration")
    parser.add_argument("--num-resets", type=int, default=defaults.num_resets, help="starts (default: %(default)s)")
    parser.add_argument(
        "--num-still", type=int, default=defaults.num_still, help="worlds standing still (default: %(default)s)"
    )
    parser.add_argument(
        "--num-random", type=int, default=defaults.num_random, help="with random commands (default: %(default)s)"
    )
    parser.add_argument("--time-limit-s", type=float, help="of these worlds (default: the task's own time limit)")
    parser.add_argument("--seed", type=int, default=defaults.seed, help="of starts and commands (default: %(default)s)")


def main(arguments: argparse.Namespace) -> int:
    """Print a table a task, then one line of JSON; exit code 1 where a check failed."""
    settings = Settings(
        num_resets=arguments.num_resets,
        num_still=arguments.num_still,
        num_random=arguments.num_random,
        seed=arguments.seed,
        time_limit_s=arguments.time_limit_s,
    )
    everything = arguments.task == ALL
    if everything and arguments.root is not None:
        raise DemoHLMError(f"--root with {ALL!r}", "one task", "name the task of that demonstration")
    failed: dict[str, list[str]] = {}
    for task in all_tasks().values() if everything else [get_task(arguments.task)]:
        demonstration = None if arguments.no_demonstration else load(arguments.root, task)
        checks = lint(task, demonstration, settings)
        failed[task.name] = [check.name for check in checks if not check.ok]
        print(format_table(task.name, checks), end="\n\n", flush=True)
    ok = not any(failed.values())
    print(json.dumps({"ok": ok, "failed": failed, **asdict(settings)}))
    return 0 if ok else 1
