"""Trained weights -> the same weights with a velocity map, so that robots walk at the commanded velocity.

A policy walks a little too slowly, because its pelvis sways less then. What is missing depends on the command and on
hardly anything else, see ``control.velocity_map``.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_demohlm.control import command, controllers, velocity_map
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import Weights, WholeBodyController
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.trial import trial_task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

_NUM_ROBOTS, _SETTLE_S, _LOOK_S = 384, 3.0, 4.0
_BEYOND = 1.25  # times the range of commands: a slow policy needs a larger velocity than the commanded one
_LEAST_UP = 0.5  # share of the robots below which nothing can be told


class Walked(NamedTuple):
    """What robots that did not fall were told, and what they did on average.

    Attributes:
        told: (N, 7) commands, as the controller got them.
        velocity: (N, 2) forward and sideways in the heading frame [m/s].
        up: Share of the robots that did not fall.
    """

    told: np.ndarray
    velocity: np.ndarray
    up: float


class _FurtherController(WholeBodyController):
    """A controller that gets several times the commanded velocity: a simulation keeps commands within their range.

    Args:
        num_worlds: N.
        weights: As in ``WholeBodyController``.
        beyond: The factor.
    """

    def __init__(self, num_worlds: int, weights: Path, beyond: float) -> None:
        super().__init__(num_worlds, weights)
        self._beyond = beyond

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance by a tick; arguments as in the base class."""
        return super().step(sensed, _further(commands, self._beyond), worlds)


def _further(commands: np.ndarray, beyond: float) -> np.ndarray:
    """Return commands (N, 23) with their velocities times a factor."""
    found = commands.copy()
    found[:, command.VELOCITY] *= beyond
    return found


def walk(weights: Path, num_robots: int, seed: int = 0, beyond: float = _BEYOND) -> Walked:
    """Let every robot walk with one command, drawn from the whole range, on the deployment model.

    Args:
        weights: Of the controller.
        num_robots: N.
        seed: Of the commands.
        beyond: Factor on the range of velocities.
    """
    rng, n, ranges = np.random.default_rng(seed), num_robots, CommandRange()
    controller = _FurtherController(n, weights, beyond)
    simulation = Simulation(trial_task(), n, controller=controller)
    commands = np.tile(command.rest(), (n, 1))
    velocities = [rng.uniform(*limits, n) for limits in (ranges.forward, ranges.sideways, ranges.yaw_rate)]
    commands[:, command.VELOCITY] = np.stack(velocities, axis=1)
    commands[:, command.HEIGHT] = rng.uniform(*ranges.walking_height, n)
    commands[:, command.PITCH] = rng.uniform(*ranges.walking_pitch, n)
    simulation.reset([simulation.task.default_state()] * n)
    cycle, means = CycleMean(simulation, controller.cycle_s), []
    for step in range(round((_SETTLE_S + _LOOK_S) / STEP_DT)):
        simulation.step(commands)
        cycle.add()
        if step * STEP_DT >= _SETTLE_S:
            means.append(cycle.mean()[:, :2])
    up = ~simulation.fallen()
    simulation.close()
    told = _further(commands, beyond)[up, :7]
    return Walked(told=told, velocity=np.mean(means, axis=0)[up], up=float(up.mean()))


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
        found = walk(plain, _NUM_ROBOTS)
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
