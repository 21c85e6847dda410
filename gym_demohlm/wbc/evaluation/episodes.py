"""Random commands -> what robots make of them over an episode: tracking errors, falls, sliding, power.

500 Hz, all collisions, the same simulation that tasks run in. Commands are drawn uniformly from their whole range and
redrawn every 4 s, worlds standing and walking by turns; arms move between random poses all the time, clear of the
robot's own body, with a load in each hand; errors count from 1.5 s after each redraw.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np

from gym_demohlm.control import attitude, command
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Controller, Simulation
from gym_demohlm.timing import STEP_DT
from gym_demohlm.wbc.evaluation.commanded_posture import Figure
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.trial import Disturbance
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange, Driver

REDRAW_S, SETTLE_S = 4.0, 1.5
PUSH_EVERY_S, PUSH_SPEED = 3.0, 0.5  # s, m/s
NUM_LOADS = 8  # pairs of hand loads; worlds are shared among them
POSTURES = ("walking", "upright", "turned", "low", "bent", "low and bent")
_LOW, _BENT, _ROLLED, _TURNED = 0.60, 0.4, 0.2, 0.5  # m, rad, rad, rad: from where on a robot that stands is that
TOUCHING = 5.0  # N: a sole that bears this much stands on the floor
Maker = Callable[[int, Disturbance, int], Simulation]
"""Number of worlds, what disturbs them, threads of the physics -> worlds with a controller in them."""


def tracked(simulation: Simulation) -> dict[str, np.ndarray]:
    """Return what each robot does (N,) in the quantities that it is commanded.

    Velocities are instantaneous, in the heading frame of the pelvis [m/s, rad/s]; height [m]; torso angles [rad].
    """
    T_pelvis, T_torso = simulation.pose("pelvis"), simulation.pose("torso")
    heading = np.arctan2(T_pelvis[:, 1, 0], T_pelvis[:, 0, 0])
    velocity = simulation.velocity("pelvis")[:, :3]
    cos, sin = np.cos(heading), np.sin(heading)
    roll, pitch = attitude.roll_pitch(-T_torso[:, 2, :3])
    return {
        "forward": cos * velocity[:, 0] + sin * velocity[:, 1],
        "sideways": cos * velocity[:, 1] - sin * velocity[:, 0],
        "yaw_rate": (T_pelvis[:, 2, :3] * simulation.gyro).sum(axis=1),
        "height": T_pelvis[:, 2, 3],
        "roll": roll,
        "pitch": pitch,
        "yaw": simulation.joint_positions[:, g1.BODY_JOINTS.index("waist_yaw")],
    }


def _errors(simulation: Simulation, commands: np.ndarray) -> dict[str, np.ndarray]:
    """Return instantaneous errors (N,) of each tracked quantity."""
    found = tracked(simulation)
    forward, sideways = found["forward"], found["sideways"]
    return {
        "linear_velocity": np.hypot(forward - commands[:, 0], sideways - commands[:, 1]),
        "yaw_rate": np.abs(found["yaw_rate"] - commands[:, 2]),
        "height": np.abs(found["height"] - commands[:, command.HEIGHT]),
        "torso_roll": np.abs(found["roll"] - commands[:, command.ROLL]),
        "torso_pitch": np.abs(found["pitch"] - commands[:, command.PITCH]),
        "torso_yaw": np.abs(found["yaw"] - commands[:, command.YAW]),
        "drift": np.hypot(forward, sideways),
    }


class Trialled(Controller, Protocol):
    """What the benchmark asks of a controller besides what a simulation does."""

    @property
    def cycle_s(self) -> float:
        """Period of its gait [s]."""
        ...

    @property
    def standing(self) -> np.ndarray:
        """Who does not step, (N,) bool."""
        ...


@dataclass(frozen=True, kw_only=True)
class Fall:
    """A robot that fell.

    Attributes:
        time_s: When, from the start of its episode [s].
        posture: What it was told, one of ``POSTURES``.
        command: (7,) the same in numbers: velocity, height, roll, pitch, yaw.
    """

    time_s: float
    posture: str
    command: np.ndarray


@dataclass
class Samples:
    """What one group of worlds showed.

    Attributes:
        sums: Name -> sum and number of the samples of each robot, (2, N).
        alive: (N,) bool, who never fell.
        told: Posture -> how often a robot that was up was told to take it.
        falls: In their order.
    """

    sums: dict[str, np.ndarray]
    alive: np.ndarray
    told: dict[str, int] = field(default_factory=lambda: dict.fromkeys(POSTURES, 0))
    falls: list[Fall] = field(default_factory=list)

    def add(self, name: str, values: np.ndarray, robots: np.ndarray) -> None:
        """Add a sample (n,) of a quantity for each of some robots (n,)."""
        sums = self.sums.setdefault(name, np.zeros((2, len(self.alive))))
        sums[:, robots] += np.stack([values, np.ones(len(values))])


def summarise(groups: list[Samples]) -> dict[str, float]:
    """Return the mean of every quantity over all groups, and survival."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(name for group in groups for name in group.sums):
        total, count = np.sum([group.sums[name].sum(axis=1) for group in groups if name in group.sums], axis=0)
        found[name] = float(total / max(count, 1))
    return {**found, "survival": float(np.concatenate([group.alive for group in groups]).mean())}


def posture(told: np.ndarray, walks: bool) -> str:
    """Return which of ``POSTURES`` a command (7 or more,) asks for."""
    if walks:
        return "walking"
    low, bent = told[command.HEIGHT] < _LOW, told[command.PITCH] > _BENT
    turned = abs(told[command.ROLL]) > _ROLLED or abs(told[command.YAW]) > _TURNED
    return ("low and bent" if low else "bent") if bent else "low" if low else "turned" if turned else "upright"


def falls_by_posture(groups: list[Samples]) -> dict[str, dict[str, int]]:
    """Return how often each posture was asked for and how many robots fell in it."""
    return {
        name: {
            "told": sum(group.told[name] for group in groups),
            "falls": sum(fall.posture == name for group in groups for fall in group.falls),
        }
        for name in POSTURES
    }


def measure(
    simulation: Simulation,
    seconds: float,
    seed: int,
    *,
    push_speed: float = 0.0,
    ranges: CommandRange | None = None,
) -> Samples:
    """Let every world of a simulation follow random commands for one episode.

    Args:
        simulation: Of ``trial_task``; reset here. Its controller is a ``Trialled`` one.
        seconds: Length of an episode.
        seed: Of commands and pushes.
        push_speed: Sudden horizontal velocity [m/s] in a random direction every 3 s.
        ranges: What to draw commands from.
    """
    rng = np.random.default_rng(seed)
    n, controller = simulation.num_worlds, cast(Trialled, simulation.controller)
    simulation.reset([simulation.task.default_state()] * n)
    figure = Figure(simulation.model, Weights().make_reference())
    driver = Driver(ranges or CommandRange(), n, rng, figure)
    samples = Samples({}, np.ones(n, dtype=bool))
    cycle = CycleMean(simulation, controller.cycle_s)
    redraw, settle, push = (round(span / STEP_DT) for span in (REDRAW_S, SETTLE_S, PUSH_EVERY_S))
    for step in range(round(seconds / STEP_DT)):
        if step % redraw == 0:
            driver.redraw()
            for world in np.flatnonzero(samples.alive):
                samples.told[posture(driver.commands[world], bool(driver.walks[world]))] += 1
        if push_speed and step % push == push - 1:
            push_robots(simulation, push_speed, rng)
        commands = driver.step()
        result = simulation.step(commands, active=samples.alive)
        cycle.add()
        fell = samples.alive & (simulation.fallen() | result.unstable)
        samples.alive &= ~fell
        for world in np.flatnonzero(fell):
            told = commands[world, : command.ARMS.start]
            name = posture(told, bool(driver.walks[world]))
            samples.falls.append(Fall(time_s=(step + 1) * STEP_DT, posture=name, command=told))
        if step % redraw >= settle:
            found = _errors(simulation, commands) | _efforts(simulation)
            found["reflex"] = (~controller.standing).astype(float)
            if step % redraw >= settle + cycle.steps:
                error = cycle.mean() - commands[:, command.VELOCITY]
                found["linear_velocity_cycle"] = np.hypot(error[:, 0], error[:, 1])
                found["yaw_rate_cycle"] = np.abs(error[:, 2])
            for mode, mask in (("walking", driver.walks), ("standing", ~driver.walks)):
                robots = np.flatnonzero(samples.alive & mask)
                for name, values in found.items():
                    samples.add(f"{mode}/{name}", values[robots], robots)
    return samples


def _efforts(simulation: Simulation) -> dict[str, np.ndarray]:
    """Return mechanical power [W] and slip of the soles that bear load [m/s], each (N,), means of the last step."""
    n = simulation.num_worlds
    power, slip = np.zeros(n), np.zeros(n)
    for joint in g1.BODY_JOINTS:
        worlds, torque = simulation.readings(f"{joint}_torque")
        power[worlds] += np.abs(torque * simulation.readings(f"{joint}_speed")[1]).mean(axis=(1, 2))
    loaded = np.zeros(n)
    for side in g1.SIDES:
        worlds, speed = simulation.readings(f"{side}_sole_speed")
        touch = simulation.readings(f"{side}_sole_touch")[1][..., 0] > TOUCHING
        slip[worlds] += (np.hypot(speed[..., 0], speed[..., 1]) * touch).sum(axis=1)
        loaded[worlds] += touch.sum(axis=1)
    return {"power": power, "slip": slip / np.maximum(loaded, 1)}


def push_robots(simulation: Simulation, speed: float | np.ndarray, rng: np.random.Generator) -> None:
    """Change the horizontal velocity of every robot at once, in a random direction, by ``speed`` [m/s], one or (N,)."""
    angle = rng.uniform(-np.pi, np.pi, simulation.num_worlds)
    velocity = simulation.velocity("pelvis")
    velocity[:, 0] += speed * np.cos(angle)
    velocity[:, 1] += speed * np.sin(angle)
    simulation.set_velocity("pelvis", velocity)


PLAIN_ROWS = {
    "linear_velocity_error": "walking/linear_velocity",
    "yaw_rate_error": "walking/yaw_rate",
    "linear_velocity_error_cycle": "walking/linear_velocity_cycle",
    "yaw_rate_error_cycle": "walking/yaw_rate_cycle",
    "height_error": "standing/height",
    "torso_pitch_error": "standing/torso_pitch",
    "torso_roll_error": "standing/torso_roll",
    "torso_yaw_error": "standing/torso_yaw",
    "standing_drift": "standing/drift",
    "reflex_share": "standing/reflex",
    "walking_slip": "walking/slip",
    "standing_slip": "standing/slip",
    "walking_power": "walking/power",
    "standing_power": "standing/power",
}
"""Number of the benchmark -> the mean that it is, of robots with loads."""
LIGHT_ROWS = {"walking_power": "walking/power", "walking_slip": "walking/slip"}
"""The same of robots that follow velocities only; their names end in ``_velocity_only``."""


@dataclass(frozen=True, kw_only=True)
class Trials:
    """What all robots of a benchmark showed, in groups that share loads and seed.

    Attributes:
        plain: Without pushes.
        pushed: With pushes and the same loads. Commands are drawn alike, but are others from the first push on: both
            come from one generator.
        light: Velocities only, empty hands, without pushes.
        loads: Masses in the left and right hand of each group of the first two [kg].
    """

    plain: list[Samples] = field(default_factory=list)
    pushed: list[Samples] = field(default_factory=list)
    light: list[Samples] = field(default_factory=list)
    loads: list[tuple[float, float]] = field(default_factory=list)

    def rows(self) -> dict[str, float]:
        """Return the benchmark's numbers by their names, for people and for comparisons."""
        errors, pushed, light = summarise(self.plain), summarise(self.pushed), summarise(self.light)
        found = {row: errors.get(name, math.nan) for row, name in PLAIN_ROWS.items()}
        found |= {f"{row}_velocity_only": light.get(name, math.nan) for row, name in LIGHT_ROWS.items()}
        return found | {"survival": errors["survival"], "survival_pushed": pushed["survival"]}

    def falls_by_load(self) -> list[dict[str, Any]]:
        """Return how many robots of each group fell."""
        return [
            {"loads": loads, "robots": len(a.alive), "falls": len(a.falls), "falls_pushed": len(b.falls)}
            for loads, a, b in zip(self.loads, self.plain, self.pushed, strict=True)
        ]


def trials(
    num_worlds: int,
    seconds: float,
    seed: int,
    num_threads: int,
    ranges: CommandRange,
    *,
    num_seeds: int,
    largest_hand_load: float,
    make: Maker,
) -> Trials:
    """Try a controller; arguments as ``benchmark``."""
    found = Trials()
    for own_seed, robots in enumerate(np.array_split(np.arange(num_worlds), num_seeds), start=seed):
        loads = np.random.default_rng(own_seed).uniform(0, largest_hand_load, (NUM_LOADS, 2))
        for index, share in enumerate(np.array_split(robots, NUM_LOADS)):
            if len(share) == 0:
                continue
            pair = (float(loads[index, 0]), float(loads[index, 1]))
            simulation = make(len(share), Disturbance(hand_loads=pair), num_threads)
            drawn = NUM_LOADS * own_seed + index
            found.plain.append(measure(simulation, seconds, drawn, ranges=ranges))
            found.pushed.append(measure(simulation, seconds, drawn, ranges=ranges, push_speed=PUSH_SPEED))
            found.loads.append(pair)
            simulation.close()
        simulation = make(max(2, len(robots) // 4), Disturbance(), num_threads)
        found.light.append(measure(simulation, seconds, own_seed, ranges=ranges.velocity_only()))
        simulation.close()
    return found
