"""A task -> a table of checks of what it calls success and failure, what a policy sees, and what its physics does.

A success condition must be false at every reset, out of reach of a robot that stands still or gets random commands,
and last in the task's demonstration. The same episodes, the demonstration's replay and its replays from other starts
are watched for MuJoCo's warnings, for numbers that are not finite or never change, and for things that sink into one
another. With random commands a robot strikes things, falls over them and throws them down; at such an impact two
things may be inside each other for an instant by as much as they move in one step of the physics, before the contact is
found. That depth has a line and a limit of its own, beside the depth that lasts. What the trunk leans on is judged by
that limit too.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.envs import observation
from gym_demohlm.envs.episode import max_episode_steps
from gym_demohlm.errors import DemoHLMError
from gym_demohlm.robot.robot import GRIPPER_JOINTS
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import DEFAULT_REGION, WIDEST, Task
from gym_demohlm.timing import HOLD_S, HOLD_STEPS, PHYSICS_DT, STEP_DT
from gym_demohlm.variation import get_variation
from lerobot_demohlm.checks.overlaps import Overlap, OverlapWatch
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations.demonstration import Demonstration

REPLAYS_TOGETHER = 8  # side by side
MIN_SUCCESS = 0.5  # of the replays
MAX_DEPTH = 0.005  # m that one thing may be inside another
IMPACT_SPEED = 5.0  # m/s, of what falls off a table, or of a hand when the robot falls
MAX_IMPACT_DEPTH = MAX_DEPTH + IMPACT_SPEED * PHYSICS_DT
LEAST_CHANGE = 1e-6  # of a number of the observation over all starts and steps; below it is rounding
PERIODS = (1, 10)  # steps after which a random command is followed by the next, in turn from world to world


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How thoroughly a task is checked.

    Attributes:
        num_resets: Starts that are looked at, spread evenly over the task's regions; and as many in R4.
        num_still: Worlds whose robot stands still for the time limit, R1 to R3 in turn.
        num_episodes: Worlds whose robot gets uniformly random commands for the time limit, R1 to R3 in turn;
            and replays of the demonstration from as many other starts in R3.
        seed: Of the starts and the commands.
        time_limit_s: How long those worlds run [s]; None: for the task's own time limit.
        variation: How worlds differ; the demonstration itself is replayed in the plain world.
        controller: Name, path or hash of the whole-body controller.
    """

    num_resets: int = 102
    num_still: int = 3
    num_episodes: int = 12
    seed: int = 0
    time_limit_s: float | None = None
    variation: str = "none"
    controller: str = DEFAULT

    def __post_init__(self) -> None:
        for name in ("num_resets", "num_still", "num_episodes"):
            if getattr(self, name) < 1:
                raise DemoHLMError(f"{name}={getattr(self, name)}", "at least 1", "raise it")
        if self.time_limit_s is not None and not self.time_limit_s > 0:
            raise DemoHLMError(f"time_limit_s={self.time_limit_s}", "more than 0 s", "raise it")
        get_variation(self.variation)
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
        number: What was found, as one number: a count, a time [s] or a depth [mm].
    """

    name: str
    got: str
    expected: str
    ok: bool
    number: float


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
    if DEFAULT_REGION in task.regions and WIDEST not in task.regions:
        checks += _check_resets(task.at(WIDEST), settings, f" in {WIDEST}")
    if demonstration is not None:
        checks += [*_check_demonstration(task, demonstration, settings), *_check_replays(task, demonstration, settings)]
    return checks


def _check_resets(task: Task, settings: Settings, where: str = "") -> list[Check]:
    """Look at starts in each region of a task; ``where`` ends the names of the checks."""
    generators = {name: np.random.default_rng([settings.seed, index]) for index, name in enumerate(task.regions)}
    regions = _regions(task, settings.num_resets)
    variation = get_variation(settings.variation)
    sim = Simulation(task, settings.num_resets, controller=settings.controller, variation=variation)
    watch = OverlapWatch(sim)
    sim.reset([sim.vary(task.sample(region, generators[region])) for region in regions])
    watch.look(np.arange(settings.num_resets))
    looked_at = f"{settings.num_resets} resets in {', '.join(task.regions)}"
    checks = [
        _never(f"success at a reset{where}", sim.success(), looked_at),
        _never(f"failure at a reset{where}", _any_failure(sim), looked_at),
        _depth_check(f"depth at a reset{where}", watch.deepest),
    ]
    sim.close()
    return checks


def _check_episodes(task: Task, settings: Settings) -> list[Check]:
    """Run the worlds that stand still and, after them, those with random commands, together.

    A world whose robot falls, or whose physics breaks down, starts again elsewhere, so that each runs for the whole
    time limit.
    """
    num_still, num_worlds = settings.num_still, settings.num_still + settings.num_episodes
    generators = [np.random.default_rng([settings.seed, 100, world]) for world in range(num_worlds)]
    regions = [*_regions(task, num_still), *_regions(task, settings.num_episodes)]
    variation = get_variation(settings.variation)
    sim = Simulation(task, num_worlds, controller=settings.controller, variation=variation)
    watch = OverlapWatch(sim)
    commands = np.tile(command.rest(), (num_worlds, 1))
    success, failure, broken, falls = (np.zeros(num_worlds, dtype=int) for _ in range(4))
    restart, seen = np.arange(num_worlds), []
    limit_s = settings.time_limit_s
    num_steps = max_episode_steps(task) if limit_s is None else max(1, round(limit_s / STEP_DT))
    for step in range(num_steps):
        if len(restart):
            sim.reset([sim.vary(task.sample(regions[world], generators[world])) for world in restart], restart)
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
    zero = _zero_by_definition(sim)
    sim.close()
    still, moved = slice(0, num_still), slice(num_still, None)
    standing = f"{num_still} worlds of {num_steps * STEP_DT:g} s, {falls[still].sum()} falls"
    random = f"{settings.num_episodes} worlds of {num_steps * STEP_DT:g} s, {falls[moved].sum()} falls"
    return [
        _never("success standing still", success[still], standing),
        _never("failure standing still", failure[still], standing),
        _never("success by random commands", success[moved], random),
        *_check_observations(task, np.stack(seen), zero),
        _never("MuJoCo warning, NaN or speed", broken, f"{num_worlds} worlds"),
        _depth_check("depth in these worlds", watch.lasting),
        _depth_check("depth at impacts in these worlds", watch.deepest, MAX_IMPACT_DEPTH),
    ]


def _zero_by_definition(sim: Simulation) -> set[str]:
    """Return the names of the numbers that a policy sees and that stay zero, whatever happens.

    A hand without a gripper has its place in the observation all the same. A round object is reported with its x axis
    where the camera heads: where it always stands upright, as furniture does, its y axis is level and across.
    """
    zero = {f"{joint}.{kind}" for joint in GRIPPER_JOINTS for kind in ("pos", "vel") if sim.task.hands == "rubber"}
    for entry in sim.task.objects:
        stands = sim.model.body(entry.name).mocapid[0] >= 0
        if entry.symmetry == "any" and stands:
            zero.add(f"{entry.name}_r12.pos")
    return zero


def _check_observations(task: Task, seen: np.ndarray, zero: set[str]) -> list[Check]:
    """Check the observations (steps, N, numbers), of which those called ``zero`` need not change."""
    names = np.array([*observation.STATE_NAMES, *observation.environment_names(task)])
    numbers = seen.reshape(-1, seen.shape[-1])
    infinite = names[~np.isfinite(numbers).all(axis=0)]
    constant = set(names[np.ptp(numbers, axis=0) < LEAST_CHANGE]) - zero
    return [
        _none("observation finite", infinite, "none that is not"),
        _none("observation changes", constant, "none that never does"),
    ]


def _check_demonstration(task: Task, demonstration: Demonstration, settings: Settings) -> list[Check]:
    sim = Simulation(task, controller=settings.controller)
    watch = OverlapWatch(sim)
    sim.restore(demonstration.start)
    watch.look(np.arange(1))
    success, failure = [], []
    for action in demonstration.action:
        sim.step(action[None].astype(np.float64))
        success.append(bool(sim.success()[0]))
        failure.append(bool(_any_failure(sim)[0]))
    runs = _run_lengths(success)
    longest = max(runs, default=0)
    spans = ", ".join(f"{length * STEP_DT:.1f} s" for length in runs) or "never"
    checks = [
        Check(
            name="demonstration: success ever",
            got=spans,
            expected="once or more",
            ok=longest > 0,
            number=len(runs),
        ),
        Check(
            name="demonstration: success at the end",
            got="yes" if success[-1] else "no",
            expected="yes",
            ok=success[-1],
            number=float(success[-1]),
        ),
        Check(
            name="demonstration: success held",
            got=f"{longest * STEP_DT:.1f} s",
            expected=f"{HOLD_S:.1f} s or more",
            ok=longest >= HOLD_STEPS,
            number=longest * STEP_DT,
        ),
        _never("demonstration: failure", np.array(failure), f"{len(failure)} steps"),
        _never("demonstration: MuJoCo warning, NaN or speed", sim.unstable, "1 replay"),
        _depth_check("demonstration: depth", watch.deepest),
    ]
    sim.close()
    return checks


def _check_replays(task: Task, demonstration: Demonstration, settings: Settings) -> list[Check]:
    """Replay the demonstration from other starts, as a generation run of that seed without noise does."""
    from lerobot_demohlm.generation import stages
    from lerobot_demohlm.generation.attempt import Attempts

    count, region = settings.num_episodes, list(task.regions)[-1]
    worlds, variation = min(count, REPLAYS_TOGETHER), get_variation(settings.variation)
    sim, broken = Simulation(task, worlds, controller=settings.controller, variation=variation), 0
    watch = OverlapWatch(sim)
    plain = stages.Settings(variation=replace(PLAIN, variation=settings.variation))
    attempts = Attempts(task, demonstration, region, settings.seed, settings=plain, sim=sim)
    outcomes: Counter[str] = Counter()
    for first in range(0, count, sim.num_worlds):
        outcomes.update(episode.outcome for episode in attempts.run(range(first, min(first + sim.num_worlds, count))))
        broken += int(sim.unstable.sum())
    attempts.close()
    share = outcomes["success"] / count
    return [
        Check(
            name="replays: success",
            got=", ".join(f"{number} {outcome}" for outcome, number in outcomes.most_common()) + f" in {region}",
            expected=f"{MIN_SUCCESS:.0%} or more",
            ok=share >= MIN_SUCCESS,
            number=share,
        ),
        _never("replays: MuJoCo warning, NaN or speed", np.ones(broken), f"{count} replays"),
        _depth_check("replays: depth", watch.deepest),
    ]


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
    return Check(name=name, got=f"{count} in {where}", expected="0", ok=count == 0, number=count)


def _none(name: str, found: set[str] | np.ndarray, expected: str) -> Check:
    got = ", ".join(sorted(map(str, found))) or "none"
    return Check(name=name, got=got, expected=expected, ok=len(found) == 0, number=len(found))


def _depth_check(name: str, overlap: Overlap, limit: float = MAX_DEPTH) -> Check:
    got = f"{1000 * overlap.depth:.1f} mm" + (f", {overlap.where}" if overlap.depth > limit else "")
    return Check(
        name=name,
        got=got,
        expected=f"{1000 * limit:g} mm or less",
        ok=overlap.depth <= limit,
        number=round(1000 * overlap.depth, 2),
    )


def format_table(title: str, checks: Sequence[Check]) -> str:
    """Return the checks as lines of text in four columns: check, got, expected, ok."""
    rows = [("check", "got", "expected", "ok")]
    rows += [(check.name, check.got, check.expected, "yes" if check.ok else "NO") for check in checks]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]) for row in rows
    ]
    return "\n".join([title, *lines])
