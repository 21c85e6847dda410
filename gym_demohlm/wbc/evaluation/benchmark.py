"""Controllers -> their summary, robustness and time: ``demohlm benchmark controller``.

What robots are asked for and what is measured is in ``episodes``.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT, STEP_DT
from gym_demohlm.wbc.evaluation.episodes import PUSH_SPEED, Maker, falls_by_posture, measure, summarise, trials
from gym_demohlm.wbc.evaluation.intervals import wilson
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_simulation, trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

LARGEST_HAND_LOAD = 2.0  # kg
ROBUSTNESS = {
    "friction_0.4": Disturbance(friction=0.4),
    "torso_3kg": Disturbance(torso_load=3.0),
    "delay_20ms": Disturbance(delay_ticks=1),
    "timestep_1ms": Disturbance(timestep=0.001),
}


BENCHMARK_TASK = trial_task()


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


def tick_share(simulation: Simulation, seconds: float = 2.0) -> float:
    """Return the controller's time on a core as a share of the physics', half of the robots walking; one thread."""
    num_worlds, controller = simulation.num_worlds, simulation.controller
    commands = np.tile(command.rest(), (num_worlds, 1))
    commands[::2, 0] = 0.3
    simulation.step(commands)  # it loads the compiled kernels
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
    found = trials(
        num_worlds,
        seconds,
        seed,
        num_threads,
        ranges,
        num_seeds=num_seeds,
        largest_hand_load=largest_hand_load,
        make=make,
    )
    rows = found.rows()
    return {
        **rows,
        "survival_low": wilson(rows["survival"], num_worlds)[0],
        "survival_pushed_low": wilson(rows["survival_pushed"], num_worlds)[0],
        "falls_by_load": found.falls_by_load(),
        "falls_by_posture": falls_by_posture(found.plain),
        "falls_by_posture_pushed": falls_by_posture(found.pushed),
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
