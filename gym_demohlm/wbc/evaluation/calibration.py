"""Trained weights -> the same weights with a velocity map, so that robots walk at the commanded velocity.

A policy walks a little too slowly, because its pelvis sways less then. What is missing depends on the command and on
hardly anything else, see ``control.velocity_map``.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_demohlm.control import command, controllers, velocity_map
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.trial import trial_simulation
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

_NUM_ROBOTS, _SETTLE_S, _LOOK_S = 384, 3.0, 4.0
_BEYOND = 1.25  # times the range of commands: a slow policy needs a larger velocity than the commanded one
_LEAST_UP = 0.5  # share of the robots below which nothing can be told


class Walked(NamedTuple):
    """What robots that did not fall were told, and what they did on average.

    Attributes:
        told: (N, 7) commands.
        velocity: (N, 2) forward and sideways in the heading frame [m/s].
        up: Share of the robots that did not fall.
    """

    told: np.ndarray
    velocity: np.ndarray
    up: float


def walk(simulation: Simulation, period_s: float, seed: int = 0, beyond: float = _BEYOND) -> Walked:
    """Let every robot walk with one command, drawn from the whole range.

    Args:
        simulation: Of ``trial_task``; reset here.
        period_s: Of the controller's gait [s].
        seed: Of the commands.
        beyond: Factor on the range of velocities.
    """
    rng, n, ranges = np.random.default_rng(seed), simulation.num_worlds, CommandRange()
    commands = np.tile(command.rest(), (n, 1))
    drawn = (ranges.forward, ranges.sideways, ranges.yaw_rate)
    velocities = [rng.uniform(beyond * low, beyond * high, n) for low, high in drawn]
    commands[:, command.VELOCITY] = np.stack(velocities, axis=1)
    commands[:, command.HEIGHT] = rng.uniform(*ranges.walking_height, n)
    commands[:, command.PITCH] = rng.uniform(*ranges.walking_pitch, n)
    simulation.reset([simulation.task.default_state()] * n)
    cycle, means = CycleMean(simulation, period_s), []
    for step in range(round((_SETTLE_S + _LOOK_S) / STEP_DT)):
        simulation.step(commands)
        cycle.add()
        if step * STEP_DT >= _SETTLE_S:
            means.append(cycle.mean()[:, :2])
    up = ~simulation.fallen()
    return Walked(told=commands[up, :7], velocity=np.mean(means, axis=0)[up], up=float(up.mean()))


def calibrate(weights: Path, output: Path) -> None:
    """Measure how a controller walks on the deployment model, and write its weights with the map that corrects it.

    Where most robots fall, the map is empty.

    Args:
        weights: An exported controller; gains of the velocity and a map in it are left out and measured anew.
        output: Of the file to write, replaced at once.

    Raises:
        SceneError: As ``control.whole_body.Weights``.
    """
    plain = output.with_suffix(".plain.npz")
    _write(weights, plain, ())
    try:
        simulation = trial_simulation(_NUM_ROBOTS, weights=plain)
        found = walk(simulation, Weights(plain).settings.gait.period_s)
        simulation.close()
        rows: tuple[tuple[float, ...], ...] = ()
        if found.up >= _LEAST_UP:
            rows = tuple(tuple(np.round(row, 6).tolist()) for row in velocity_map.fit(found.told, found.velocity))
        _write(plain, output, rows)
    finally:
        plain.unlink(missing_ok=True)


def _write(weights: Path, output: Path, rows: tuple[tuple[float, ...], ...]) -> None:
    """Write weights with another map of the velocities, and no gain of them."""
    gain = Weights(weights).settings.gain
    controllers.rewrite(weights, output, gain=[1.0, 1.0, *gain[2:]], velocity_map=rows)
