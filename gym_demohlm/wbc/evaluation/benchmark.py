"""Random commands on the deployment model -> tracking errors, survival, sliding: ``demohlm benchmark controller``.

500 Hz, all collisions, the same simulation that tasks run in. Commands are drawn uniformly from their whole range and
redrawn every 4 s, worlds standing and walking by turns; arms move between random poses all the time, clear of the
robot's own body, with a load of 0 to 2 kg in each hand; errors count from 1.5 s after each redraw.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import attitude, command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT, STEP_DT
from gym_demohlm.wbc.evaluation.commanded_posture import Figure
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_simulation, trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange, Driver

REDRAW_S, SETTLE_S = 4.0, 1.5
PUSH_EVERY_S, PUSH_SPEED = 3.0, 0.5  # s, m/s
LARGEST_HAND_LOAD = 2.0  # kg
NUM_LOADS = 8  # pairs of hand loads; worlds are shared among them
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


@dataclass
class Samples:
    """What one group of worlds showed.

    Attributes:
        sums: Name -> sum and number of samples.
        alive: (N,) bool, who never fell.
    """

    sums: dict[str, tuple[float, int]]
    alive: np.ndarray

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
        simulation: Of ``trial_task``; reset here.
        seconds: Length of an episode.
        seed: Of commands and pushes.
        push_speed: Sudden horizontal velocity [m/s] in a random direction every 3 s.
        ranges: What to draw commands from.
    """
    rng = np.random.default_rng(seed)
    n = simulation.num_worlds
    simulation.reset([simulation.task.default_state()] * n)
    figure = Figure(simulation.model, Weights().make_reference())
    driver = Driver(ranges or CommandRange(), n, rng, figure)
    samples = Samples({}, np.ones(n, dtype=bool))
    redraw, settle, push = (round(span / STEP_DT) for span in (REDRAW_S, SETTLE_S, PUSH_EVERY_S))
    for step in range(round(seconds / STEP_DT)):
        if step % redraw == 0:
            driver.redraw()
        if push_speed and step % push == push - 1:
            push_robots(simulation, push_speed, rng)
        commands = driver.step()
        result = simulation.step(commands, active=samples.alive)
        samples.alive &= ~(simulation.fallen() | result.unstable)
        if step % redraw >= settle:
            found = _errors(simulation, commands) | _efforts(simulation)
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
    """Return the controller's time as a share of the physics' time, half of the robots walking."""
    num_worlds, controller = simulation.num_worlds, simulation.controller
    commands = np.tile(command.rest(), (num_worlds, 1))
    commands[::2, 0] = 0.3
    began = time.perf_counter()
    for _ in range(round(seconds / STEP_DT)):
        simulation.step(commands)
    whole = time.perf_counter() - began
    home, still = np.tile(g1.HOME, (num_worlds, 1)), np.zeros((num_worlds, len(g1.BODY_JOINTS)))
    upright = np.tile([1.0, 0, 0, 0], (num_worlds, 1))
    sensed = Proprioception(quat_wxyz=upright, gyro=np.zeros((num_worlds, 3)), q=home, dq=still)
    began = time.perf_counter()
    for _ in range(round(seconds / CONTROL_DT)):
        controller.step(sensed, commands)
    ticks = time.perf_counter() - began
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
    largest_hand_load: float = LARGEST_HAND_LOAD,
    make: Maker | None = None,
) -> dict[str, Any]:
    """Return the summary that ``demohlm benchmark controller`` prints as its last line.

    Args:
        num_worlds: Robots in all, each one episode; shared among pairs of hand loads.
        seconds: Length of an episode.
        seed: Of loads, commands and pushes.
        num_threads: Threads of the physics.
        ranges: What to draw commands from.
        weights: Of the controller; the packaged ones by default.
        largest_hand_load: [kg].
        make: Makes the worlds; ``trial_simulation`` by default.
    """
    ranges = ranges or CommandRange()
    make = make or (lambda n, load, threads: trial_simulation(n, load, num_threads=threads, weights=weights))
    loads = np.random.default_rng(seed).uniform(0, largest_hand_load, (NUM_LOADS, 2))
    plain, pushed = [], []
    for index, share in enumerate(np.array_split(np.arange(num_worlds), NUM_LOADS)):
        if len(share) == 0:
            continue
        disturbance = Disturbance(hand_loads=(float(loads[index, 0]), float(loads[index, 1])))
        simulation = make(len(share), disturbance, num_threads)
        own_seed = NUM_LOADS * seed + index
        plain.append(measure(simulation, seconds, own_seed, ranges=ranges))
        pushed.append(measure(simulation, seconds, own_seed, ranges=ranges, push_speed=PUSH_SPEED))
        simulation.close()
    errors, errors_pushed = summarise(plain), summarise(pushed)
    return {
        "linear_velocity_error": errors["walking/linear_velocity"],
        "yaw_rate_error": errors["walking/yaw_rate"],
        "height_error": errors["standing/height"],
        "torso_pitch_error": errors["standing/torso_pitch"],
        "torso_roll_error": errors["standing/torso_roll"],
        "torso_yaw_error": errors["standing/torso_yaw"],
        "standing_drift": errors["standing/drift"],
        "walking_slip": errors["walking/slip"],
        "standing_slip": errors["standing/slip"],
        "walking_power": errors["walking/power"],
        "standing_power": errors["standing/power"],
        "survival": errors["survival"],
        "survival_pushed": errors_pushed["survival"],
        "tick_share": tick_share(make(min(num_worlds, 64), Disturbance(), 1)),
        "num_worlds": num_worlds,
        "seconds": seconds,
        "seed": seed,
        "largest_hand_load": largest_hand_load,
        "largest_roll": ranges.roll[1],
        "largest_yaw": ranges.yaw[1],
    }


def robustness(num_worlds: int, seconds: float, seed: int, num_threads: int = 2) -> dict[str, Any]:
    """Return the survival under each disturbance that training did not aim at, and with none; empty hands."""
    found: dict[str, Any] = {}
    for name, disturbance in {"none": None, **ROBUSTNESS}.items():
        simulation = trial_simulation(num_worlds, disturbance, num_threads=num_threads)
        found[f"survival/{name}"] = summarise([measure(simulation, seconds, seed)])["survival"]
        simulation.close()
    return {**found, "num_worlds": num_worlds, "seconds": seconds, "seed": seed}


def _hand_error(num_worlds: int, seed: int, num_threads: int, weights: Path | None) -> dict[str, float]:
    """Return ``reach.hand_error`` of a sixteenth of the robots, empty-handed."""
    from gym_demohlm.wbc.evaluation import reach  # loads the inverse kinematics

    simulation = trial_simulation(max(1, num_worlds // 16), num_threads=num_threads, weights=weights)
    return reach.hand_error(simulation, seed, rounds=8)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark controller``."""
    parser.add_argument("--num-worlds", type=int, default=256, help="robots, one episode each")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--roll", type=float, default=0.4, help="largest torso roll of standing robots [rad]")
    parser.add_argument("--yaw", type=float, default=1.0, help="largest torso yaw of standing robots [rad]")
    parser.add_argument("--weights", type=Path, help="other weights than the packaged ones")
    parser.add_argument("--hand-load", type=float, default=LARGEST_HAND_LOAD, help="largest mass in each hand [kg]")
    parser.add_argument(
        "--velocity-only", action="store_true", help="upright, arms still: as velocity policies are asked"
    )
    parser.add_argument("--peer", help="run a public controller instead: holosoma or holosoma-ppo")
    parser.add_argument("--peer-range", action="store_true", help="with --peer: velocities from the peer's own range")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw figures and a video into a folder instead")
    parser.add_argument("--compare", type=Path, nargs="+", metavar="RUN", help="with --figures: only training runs")
    parser.add_argument("--run", type=Path, help="with --figures: folder of a training run, for its learning curve")
    parser.add_argument(
        "--trade-off", type=Path, metavar="DIR", help="errors over shares of the range and loads instead; draws them"
    )
    parser.add_argument("--robustness", action="store_true", help="survival under disturbances instead")
    parser.add_argument("--num-threads", type=int, default=2, help="threads of the physics")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm benchmark controller``: the last line on stdout is one JSON object."""
    size = (arguments.num_worlds, arguments.seconds, arguments.seed, arguments.num_threads)
    roll, yaw = arguments.roll, arguments.yaw
    ranges = CommandRange(roll=(-roll, roll), yaw=(-yaw, yaw))
    found: dict[str, Any]
    if arguments.figures and arguments.compare:
        from gym_demohlm.wbc.evaluation import figures

        arguments.figures.mkdir(parents=True, exist_ok=True)
        figures.draw_comparison(arguments.compare, arguments.figures / "controller_comparison.png")
        found = {"figures": ["controller_comparison.png"]}
    elif arguments.figures:
        from gym_demohlm.wbc.evaluation import figures  # loads Matplotlib

        found = figures.draw(arguments.figures, arguments.weights, arguments.run, arguments.seed, arguments.num_threads)
    elif arguments.trade_off:
        from gym_demohlm.wbc.evaluation import trade_off  # loads Matplotlib

        found = trade_off.trade_off(*size, arguments.weights)
        arguments.trade_off.mkdir(parents=True, exist_ok=True)
        trade_off.draw_trade_off(found, arguments.trade_off / "controller_trade_off.png")
    elif arguments.robustness:
        found = robustness(*size)
    elif arguments.peer:
        from gym_demohlm.wbc.evaluation import peer

        found = peer.benchmark(
            arguments.peer, *size, ranges, largest_hand_load=arguments.hand_load, own_range=arguments.peer_range
        )
    else:
        ranges = ranges.velocity_only() if arguments.velocity_only else ranges
        found = benchmark(*size, ranges, arguments.weights, largest_hand_load=arguments.hand_load)
        found["velocity_only"] = arguments.velocity_only
        if not arguments.velocity_only:
            found |= _hand_error(arguments.num_worlds, arguments.seed, arguments.num_threads, arguments.weights)
    print(json.dumps(_rounded(found)))


def _rounded(value: object) -> object:
    """Return numbers, also those in lists and mappings, with five digits after the point."""
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return round(value, 5) if isinstance(value, float) else value


if __name__ == "__main__":
    _parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(_parser)
    main(_parser.parse_args())
