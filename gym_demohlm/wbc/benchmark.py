"""Random commands on the deployment model -> tracking errors, survival, sliding: ``demohlm benchmark controller``.

500 Hz, all collisions, the same simulation that tasks run in. Commands are redrawn every 4 s, half of the worlds stand
and half walk, arms move between random poses all the time; errors count from 1.5 s after each redraw.
"""

import argparse
import json
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gym_demohlm.control import command, reference
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.robot import g1
from gym_demohlm.simulation import STEP_DT, Simulation
from gym_demohlm.task import ObjectSpec, Task

REDRAW_S, SETTLE_S = 4.0, 1.5
PUSH_EVERY_S = 3.0


@dataclass(frozen=True, kw_only=True)
class CommandRange:
    """What commands are drawn from, uniformly; (low, high) each.

    Attributes:
        forward, sideways: [m/s].
        yaw_rate: [rad/s].
        height: Standing [m].
        pitch, roll, yaw: Torso, standing [rad].
        walking_height: [m].
        walking_pitch: [rad].
        arm_speed: [rad/s].
    """

    forward: tuple[float, float] = (-0.3, 0.5)
    sideways: tuple[float, float] = (-0.3, 0.3)
    yaw_rate: tuple[float, float] = (-0.6, 0.6)
    height: tuple[float, float] = (0.45, 0.76)
    pitch: tuple[float, float] = (-0.1, 0.9)
    roll: tuple[float, float] = (-0.2, 0.2)
    yaw: tuple[float, float] = (-0.6, 0.6)
    walking_height: tuple[float, float] = (0.68, 0.76)
    walking_pitch: tuple[float, float] = (-0.05, 0.3)
    arm_speed: tuple[float, float] = (0.3, 2.0)


# Arm poses in front of and beside the body [rad]: shoulder pitch, roll, yaw, elbow, wrist roll, pitch, yaw; left arm.
_ARM_LOW = np.array([-1.8, -0.1, -0.8, -0.9, -0.8, -0.8, -0.8])
_ARM_HIGH = np.array([0.6, 1.2, 0.8, 1.5, 0.8, 0.8, 0.8])
_ARM_MIRROR = np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0])


def _beacon(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_body(name="beacon", pos=[5.0, 0.0, 1.0], mocap=True)


BENCHMARK_TASK = Task(
    name="ControllerBenchmark",
    description="follow random commands",
    hands="rubber",
    build=_beacon,
    objects=(ObjectSpec(name="beacon", position=(5.0, 0.0, 1.0), placed=False),),
    success=lambda simulation: np.zeros(simulation.num_worlds, dtype=bool),
    gaze_target="beacon",
)


class _Driver:
    """Draws commands and arm motions for all worlds."""

    def __init__(self, ranges: CommandRange, num_worlds: int, rng: np.random.Generator) -> None:
        self.ranges, self.rng = ranges, rng
        self.walks = np.arange(num_worlds) % 2 == 0
        self.commands = np.tile(command.rest(), (num_worlds, 1))
        self._arm_goal = self.commands[:, command.ARMS].copy()
        self._arm_speed = np.ones((num_worlds, 1))

    def redraw(self) -> None:
        """Draw new commands; worlds swap between standing and walking."""
        rng, ranges, n = self.rng, self.ranges, len(self.commands)
        self.walks = ~self.walks
        walks = self.walks.astype(float)
        draw = {name: rng.uniform(low, high, n) for name, (low, high) in vars(ranges).items()}
        velocity = np.stack([draw["forward"], draw["sideways"], draw["yaw_rate"]], axis=1)
        self.commands[:, command.VELOCITY] = velocity * walks[:, None]
        self.commands[:, command.HEIGHT] = np.where(self.walks, draw["walking_height"], draw["height"])
        self.commands[:, command.PITCH] = np.where(self.walks, draw["walking_pitch"], draw["pitch"])
        self.commands[:, command.ROLL] = np.where(self.walks, 0.0, draw["roll"])
        self.commands[:, command.YAW] = np.where(self.walks, 0.0, draw["yaw"])

    def step(self) -> np.ndarray:
        """Move the arms on and return the commands (N, 23)."""
        rng, n = self.rng, len(self.commands)
        fresh = rng.random(n) < 0.05
        left = rng.uniform(_ARM_LOW, _ARM_HIGH, (n, 7))
        right = rng.uniform(_ARM_LOW, _ARM_HIGH, (n, 7)) * _ARM_MIRROR
        speed = rng.uniform(*self.ranges.arm_speed, (n, 1))
        self._arm_goal = np.where(fresh[:, None], np.concatenate([left, right], axis=1), self._arm_goal)
        self._arm_speed = np.where(fresh[:, None], speed, self._arm_speed)
        arms = self.commands[:, command.ARMS]
        step = self._arm_speed * STEP_DT
        self.commands[:, command.ARMS] = arms + np.clip(self._arm_goal - arms, -step, step)
        return self.commands.copy()


def _errors(simulation: Simulation, commands: np.ndarray) -> dict[str, np.ndarray]:
    """Return instantaneous errors (N,) of each tracked quantity."""
    T_pelvis, T_torso = simulation.pose("pelvis"), simulation.pose("torso")
    heading = np.arctan2(T_pelvis[:, 1, 0], T_pelvis[:, 0, 0])
    velocity = simulation.qvel[:, :3]
    cos, sin = np.cos(heading), np.sin(heading)
    forward = cos * velocity[:, 0] + sin * velocity[:, 1]
    sideways = cos * velocity[:, 1] - sin * velocity[:, 0]
    yaw_rate = (T_pelvis[:, 2, :3] * simulation.gyro).sum(axis=1)
    up = T_torso[:, 2, :3]
    waist_yaw = simulation.joint_positions[:, g1.BODY_JOINTS.index("waist_yaw")]
    return {
        "linear_velocity": np.hypot(forward - commands[:, 0], sideways - commands[:, 1]),
        "yaw_rate": np.abs(yaw_rate - commands[:, 2]),
        "height": np.abs(T_pelvis[:, 2, 3] - commands[:, command.HEIGHT]),
        "torso_roll": np.abs(np.arctan2(up[:, 1], up[:, 2]) - commands[:, command.ROLL]),
        "torso_pitch": np.abs(np.arctan2(-up[:, 0], np.hypot(up[:, 1], up[:, 2])) - commands[:, command.PITCH]),
        "torso_yaw": np.abs(waist_yaw - commands[:, command.YAW]),
        "drift": np.hypot(velocity[:, 0], velocity[:, 1]),
    }


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
    """Measure the controller once.

    Args:
        num_worlds: Robots, each one episode.
        seconds: Length of an episode.
        seed: Of commands and pushes.
        push_speed: Sudden horizontal velocity [m/s] in a random direction every 3 s.
        ranges: What to draw commands from.
        num_threads: Threads of the physics.
        simulation: To reuse; made when absent.

    Returns:
        Mean errors by mode (``walking``, ``standing``), survival, and the share of time spent in the controller.
    """
    rng = np.random.default_rng(seed)
    simulation = simulation or Simulation(BENCHMARK_TASK, num_worlds=num_worlds, num_threads=num_threads)
    simulation.reset([BENCHMARK_TASK.default_state()] * num_worlds)
    driver = _Driver(ranges or CommandRange(), num_worlds, rng)
    alive = np.ones(num_worlds, dtype=bool)
    sums: dict[str, list[np.ndarray]] = {}
    steps = round(seconds / STEP_DT)
    redraw, settle, push = (round(span / STEP_DT) for span in (REDRAW_S, SETTLE_S, PUSH_EVERY_S))
    for step in range(steps):
        if step % redraw == 0:
            driver.redraw()
        if push_speed and step % push == push - 1:
            _push(simulation, push_speed, rng)
        commands = driver.step()
        result = simulation.step(commands, active=alive)
        alive &= ~(simulation.fallen() | result.unstable)
        if step % redraw < settle:
            continue
        errors = _errors(simulation, commands)
        for name, error in errors.items():
            sums.setdefault(f"walking/{name}", []).append(error[alive & driver.walks])
            sums.setdefault(f"standing/{name}", []).append(error[alive & ~driver.walks])
    return {
        **{name: float(np.concatenate(values).mean()) for name, values in sums.items()},
        "survival": float(alive.mean()),
    }


def _push(simulation: Simulation, speed: float, rng: np.random.Generator) -> None:
    snapshot = simulation.snapshot()
    angle = rng.uniform(-np.pi, np.pi, simulation.num_worlds)
    first = 1 + simulation.model.nq + simulation.scene.base_qvel
    snapshot["physics"][:, first] += speed * np.cos(angle)
    snapshot["physics"][:, first + 1] += speed * np.sin(angle)
    simulation.restore(snapshot)


def tick_share(num_worlds: int, seconds: float = 2.0) -> float:
    """Return the controller's time as a share of the physics' time, one thread."""
    controller = WholeBodyController(num_worlds)
    simulation = Simulation(BENCHMARK_TASK, num_worlds=num_worlds, num_threads=1, controller=controller)
    commands = np.tile(command.rest(), (num_worlds, 1))
    began = time.perf_counter()
    for _ in range(round(seconds / STEP_DT)):
        simulation.step(commands)
    whole = time.perf_counter() - began
    rest = np.zeros((num_worlds, len(g1.BODY_JOINTS))) + g1.HOME
    upright = np.tile([1.0, 0, 0, 0], (num_worlds, 1))
    began = time.perf_counter()
    for _ in range(round(seconds / reference.CONTROL_DT)):
        controller.step(upright, np.zeros((num_worlds, 3)), rest, 0 * rest, commands)
    ticks = time.perf_counter() - began
    return ticks / (whole - ticks)


def benchmark(
    num_worlds: int, seconds: float, seed: int, num_threads: int = 2, ranges: CommandRange | None = None
) -> dict[str, Any]:
    """Return the summary that ``demohlm benchmark controller`` prints as its last line; arguments as in ``run``."""
    ranges = ranges or CommandRange()
    simulation = Simulation(BENCHMARK_TASK, num_worlds=num_worlds, num_threads=num_threads)
    common: dict[str, Any] = {"num_worlds": num_worlds, "seconds": seconds, "simulation": simulation, "ranges": ranges}
    plain = run(**common, seed=seed)
    pushed = run(**common, seed=seed, push_speed=0.5)
    return {
        "linear_velocity_error": plain["walking/linear_velocity"],
        "yaw_rate_error": plain["walking/yaw_rate"],
        "height_error": plain["standing/height"],
        "torso_pitch_error": plain["standing/torso_pitch"],
        "torso_roll_error": plain["standing/torso_roll"],
        "torso_yaw_error": plain["standing/torso_yaw"],
        "standing_drift": plain["standing/drift"],
        "survival": plain["survival"],
        "survival_pushed": pushed["survival"],
        "tick_share": tick_share(min(num_worlds, 64)),
        "num_worlds": num_worlds,
        "seconds": seconds,
        "seed": seed,
        "largest_roll": ranges.roll[1],
        "largest_yaw": ranges.yaw[1],
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark controller``."""
    parser.add_argument("--num-worlds", type=int, default=256, help="robots, one episode each")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--roll", type=float, default=0.2, help="largest torso roll of standing robots [rad]")
    parser.add_argument("--yaw", type=float, default=0.6, help="largest torso yaw of standing robots [rad]")
    parser.add_argument("--num-threads", type=int, default=2, help="threads of the physics")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm benchmark controller``: the last line on stdout is one JSON object."""
    roll, yaw = arguments.roll, arguments.yaw
    ranges = CommandRange(roll=(-roll, roll), yaw=(-yaw, yaw))
    found = benchmark(arguments.num_worlds, arguments.seconds, arguments.seed, arguments.num_threads, ranges)
    print(json.dumps({name: round(value, 5) if isinstance(value, float) else value for name, value in found.items()}))


if __name__ == "__main__":
    _parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(_parser)
    main(_parser.parse_args())
