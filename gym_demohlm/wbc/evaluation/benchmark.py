"""Random commands on the deployment model -> tracking errors, survival, sliding: ``demohlm benchmark controller``.

500 Hz, all collisions, the same simulation that tasks run in. Commands are drawn uniformly from their whole range and
redrawn every 4 s, worlds standing and walking by turns; arms move between random poses all the time, clear of the
robot's own body, with a load of 0 to 2 kg in each hand; errors count from 1.5 s after each redraw.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from gym_demohlm.control import attitude, command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Controller, Simulation
from gym_demohlm.timing import CONTROL_DT, STEP_DT
from gym_demohlm.wbc.evaluation.commanded_posture import Figure
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.intervals import wilson
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_simulation, trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange, Driver

REDRAW_S, SETTLE_S = 4.0, 1.5
PUSH_EVERY_S, PUSH_SPEED = 3.0, 0.5  # s, m/s
LARGEST_HAND_LOAD = 2.0  # kg
NUM_LOADS = 8  # pairs of hand loads; worlds are shared among them
POSTURES = ("walking", "upright", "turned", "low", "bent", "low and bent")
_LOW, _BENT, _ROLLED, _TURNED = 0.60, 0.4, 0.2, 0.5  # m, rad, rad, rad: from where on a robot that stands is that
TOUCHING = 5.0  # N: a sole that bears this much stands on the floor
ROBUSTNESS = {
    "friction_0.4": Disturbance(friction=0.4),
    "torso_3kg": Disturbance(torso_load=3.0),
    "delay_20ms": Disturbance(delay_ticks=1),
    "timestep_1ms": Disturbance(timestep=0.001),
}


BENCHMARK_TASK = trial_task()
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
        sums: Name -> sum and number of samples.
        alive: (N,) bool, who never fell.
        told: Posture -> how often a robot that was up was told to take it.
        falls: In their order.
    """

    sums: dict[str, tuple[float, int]]
    alive: np.ndarray
    told: dict[str, int] = field(default_factory=lambda: dict.fromkeys(POSTURES, 0))
    falls: list[Fall] = field(default_factory=list)

    def add(self, name: str, values: np.ndarray) -> None:
        """Add samples of a quantity."""
        total, count = self.sums.get(name, (0.0, 0))
        self.sums[name] = total + float(values.sum()), count + values.size


def summarise(groups: list[Samples]) -> dict[str, float]:
    """Return the mean of every quantity over all groups, and survival."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(name for group in groups for name in group.sums):
        parts = [group.sums.get(name, (0.0, 0)) for group in groups]
        found[name] = sum(total for total, _ in parts) / max(sum(count for _, count in parts), 1)
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
                for name, values in found.items():
                    samples.add(f"{mode}/{name}", values[samples.alive & mask])
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


def run(
    *,
    num_worlds: int,
    seconds: float,
    seed: int,
    push_speed: float = 0.0,
    ranges: CommandRange | None = None,
    num_threads: int = 2,
    simulation: Simulation | None = None,
) -> dict[str, Any]:
    """Measure the controller once, with empty hands.

    Args:
        num_worlds: Robots, each one episode.
        seconds: Length of an episode.
        seed: Of commands and pushes.
        push_speed: Sudden horizontal velocity [m/s] in a random direction every 3 s.
        ranges: What to draw commands from.
        num_threads: Threads of the physics.
        simulation: To reuse; made when absent.

    Returns:
        Mean errors by mode (``walking``, ``standing``) and survival.
    """
    simulation = simulation or Simulation(BENCHMARK_TASK, num_worlds=num_worlds, num_threads=num_threads)
    return summarise([measure(simulation, seconds, seed, push_speed=push_speed, ranges=ranges)])


def push_robots(simulation: Simulation, speed: float | np.ndarray, rng: np.random.Generator) -> None:
    """Change the horizontal velocity of every robot at once, in a random direction, by ``speed`` [m/s], one or (N,)."""
    angle = rng.uniform(-np.pi, np.pi, simulation.num_worlds)
    velocity = simulation.velocity("pelvis")
    velocity[:, 0] += speed * np.cos(angle)
    velocity[:, 1] += speed * np.sin(angle)
    simulation.set_velocity("pelvis", velocity)


def tick_share(simulation: Simulation, seconds: float = 2.0) -> float:
    """Return the controller's time on a core as a share of the physics', half of the robots walking; one thread."""
    num_worlds, controller = simulation.num_worlds, simulation.controller
    commands = np.tile(command.rest(), (num_worlds, 1))
    commands[::2, 0] = 0.3
    began = time.process_time()
    for _ in range(round(seconds / STEP_DT)):
        simulation.step(commands)
    whole = time.process_time() - began
    home, still = np.tile(g1.HOME, (num_worlds, 1)), np.zeros((num_worlds, len(g1.BODY_JOINTS)))
    upright = np.tile([1.0, 0, 0, 0], (num_worlds, 1))
    sensed = Proprioception(quat_wxyz=upright, gyro=np.zeros((num_worlds, 3)), q=home, dq=still)
    began = time.process_time()
    for _ in range(round(seconds / CONTROL_DT)):
        controller.step(sensed, commands)
    ticks = time.process_time() - began
    return ticks / (whole - ticks)


def quick(weights: Path, num_worlds: int = 32, seconds: float = 8.0) -> dict[str, float]:
    """Measure some weights briefly, for the log of a training run: errors by mode and survival, pushed or not."""
    simulation = trial_simulation(num_worlds, weights=weights)
    found = run(num_worlds=num_worlds, seconds=seconds, seed=7, simulation=simulation)
    pushed = run(num_worlds=num_worlds, seconds=seconds, seed=7, simulation=simulation, push_speed=PUSH_SPEED)
    return {name: round(value, 4) for name, value in {**found, "survival_pushed": pushed["survival"]}.items()}


def benchmark(
    num_worlds: int,
    seconds: float,
    seed: int,
    num_threads: int = 2,
    ranges: CommandRange | None = None,
    weights: Path | None = None,
    *,
    num_seeds: int = 1,
    largest_hand_load: float = LARGEST_HAND_LOAD,
    make: Maker | None = None,
) -> dict[str, Any]:
    """Return the summary that ``demohlm benchmark controller`` prints as its last line.

    Args:
        num_worlds: Robots in all, each one episode; shared among seeds and pairs of hand loads.
        seconds: Length of an episode.
        seed: The first, of loads, commands and pushes.
        num_threads: Threads of the physics.
        ranges: What to draw commands from.
        weights: Of the controller; the packaged ones by default.
        num_seeds: Seeds, one after another.
        largest_hand_load: [kg].
        make: Makes the worlds; ``trial_simulation`` by default.
    """
    ranges = ranges or CommandRange()
    make = make or (lambda n, load, threads: trial_simulation(n, load, num_threads=threads, weights=weights))
    plain: list[Samples] = []
    pushed: list[Samples] = []
    light: list[Samples] = []
    by_load: list[dict[str, Any]] = []
    for own_seed, robots in enumerate(np.array_split(np.arange(num_worlds), num_seeds), start=seed):
        loads = np.random.default_rng(own_seed).uniform(0, largest_hand_load, (NUM_LOADS, 2))
        for index, share in enumerate(np.array_split(robots, NUM_LOADS)):
            if len(share) == 0:
                continue
            pair = (float(loads[index, 0]), float(loads[index, 1]))
            simulation = make(len(share), Disturbance(hand_loads=pair), num_threads)
            drawn = NUM_LOADS * own_seed + index
            plain.append(measure(simulation, seconds, drawn, ranges=ranges))
            pushed.append(measure(simulation, seconds, drawn, ranges=ranges, push_speed=PUSH_SPEED))
            falls, falls_pushed = len(plain[-1].falls), len(pushed[-1].falls)
            by_load.append({"loads": pair, "robots": len(share), "falls": falls, "falls_pushed": falls_pushed})
            simulation.close()
        simulation = make(max(2, len(robots) // 4), Disturbance(), num_threads)
        light.append(measure(simulation, seconds, own_seed, ranges=ranges.velocity_only()))
        simulation.close()
    errors, errors_pushed, errors_light = summarise(plain), summarise(pushed), summarise(light)
    return {
        "linear_velocity_error": errors["walking/linear_velocity"],
        "yaw_rate_error": errors["walking/yaw_rate"],
        "linear_velocity_error_cycle": errors["walking/linear_velocity_cycle"],
        "yaw_rate_error_cycle": errors["walking/yaw_rate_cycle"],
        "height_error": errors["standing/height"],
        "torso_pitch_error": errors["standing/torso_pitch"],
        "torso_roll_error": errors["standing/torso_roll"],
        "torso_yaw_error": errors["standing/torso_yaw"],
        "standing_drift": errors["standing/drift"],
        "reflex_share": errors["standing/reflex"],
        "walking_slip": errors["walking/slip"],
        "standing_slip": errors["standing/slip"],
        "walking_power": errors["walking/power"],
        "standing_power": errors["standing/power"],
        "walking_power_velocity_only": errors_light["walking/power"],
        "walking_slip_velocity_only": errors_light["walking/slip"],
        "survival": errors["survival"],
        "survival_low": wilson(errors["survival"], num_worlds)[0],
        "survival_pushed": errors_pushed["survival"],
        "survival_pushed_low": wilson(errors_pushed["survival"], num_worlds)[0],
        "falls_by_load": by_load,
        "falls_by_posture": falls_by_posture(plain),
        "falls_by_posture_pushed": falls_by_posture(pushed),
        "tick_share": tick_share(make(min(num_worlds, 64), Disturbance(), 1)),
        "num_worlds": num_worlds,
        "num_seeds": num_seeds,
        "seconds": seconds,
        "seed": seed,
        "largest_hand_load": largest_hand_load,
        "largest_roll": ranges.roll[1],
        "largest_yaw": ranges.yaw[1],
    }


def robustness(
    num_worlds: int, seconds: float, seed: int, num_threads: int = 2, weights: Path | None = None
) -> dict[str, Any]:
    """Return the survival under each disturbance that training did not aim at, and with none; empty hands."""
    found: dict[str, Any] = {}
    for name, disturbance in {"none": None, **ROBUSTNESS}.items():
        simulation = trial_simulation(num_worlds, disturbance, num_threads=num_threads, weights=weights)
        found[f"survival/{name}"] = summarise([measure(simulation, seconds, seed)])["survival"]
        simulation.close()
    return {**found, "num_worlds": num_worlds, "seconds": seconds, "seed": seed}


def hand_error(num_worlds: int, seed: int, num_threads: int, weights: Path | None) -> dict[str, float]:
    """Return ``reach.hand_error`` of a sixteenth of the robots, empty-handed."""
    from gym_demohlm.wbc.evaluation import reach  # loads the inverse kinematics

    simulation = trial_simulation(max(1, num_worlds // 16), num_threads=num_threads, weights=weights)
    return reach.hand_error(simulation, seed, rounds=8)
