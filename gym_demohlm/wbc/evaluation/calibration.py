"""Trained weights -> the same weights with the gain that makes up for what the policy falls short of.

Rewards of the instantaneous velocity let a policy walk a little slower than it is told: its pelvis sways less then.
What is missing is a constant share of the velocity, so that a factor on what the policy is told takes it away.
"""

import json
from pathlib import Path

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.whole_body import Weights, read_arrays
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.trial import trial_simulation
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange

_NUM_ROBOTS, _SETTLE_S, _LOOK_S = 48, 3.0, 4.0
_LEAST_UP = 0.5  # share of the robots below which nothing can be told
_LARGEST = 1.5  # gain: a policy that needs more is not trained yet


def velocity_gain(simulation: Simulation, period_s: float, seed: int = 0) -> np.ndarray:
    """Return the factors on forward and sideways velocity by which robots walk as fast as they are told, (2,).

    Every robot walks with one command, drawn from the whole range. What it does on average, divided by what it was
    told, is fitted by least squares over all robots that do not fall. Where most of them do, the factors are one.

    Args:
        simulation: Of ``trial_task``; reset here.
        period_s: Of the controller's gait [s].
        seed: Of the commands.
    """
    rng, n, ranges = np.random.default_rng(seed), simulation.num_worlds, CommandRange()
    commands = np.tile(command.rest(), (n, 1))
    drawn = (ranges.forward, ranges.sideways, ranges.yaw_rate)
    commands[:, command.VELOCITY] = np.stack([rng.uniform(low, high, n) for low, high in drawn], axis=1)
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
    if up.mean() < _LEAST_UP:
        return np.ones(2)
    walked, told = np.mean(means, axis=0)[up], commands[up, :2]
    share = (walked * told).sum(axis=0) / (told**2).sum(axis=0)
    return np.clip(1.0 / np.maximum(share, 1.0 / _LARGEST), 1.0, _LARGEST)


def calibrate(weights: Path, output: Path) -> np.ndarray:
    """Measure the gain of a controller on the deployment model and write its weights with it.

    Args:
        weights: An exported controller; the gain in it is measured anew.
        output: Of the file to write, replaced at once.

    Returns:
        The factors on forward and sideways velocity, (2,).

    Raises:
        SceneError: As ``control.whole_body.Weights``.
    """
    plain = output.with_suffix(".plain.npz")
    _write(weights, plain, np.ones(2))
    try:
        simulation = trial_simulation(_NUM_ROBOTS, weights=plain)
        gain = np.round(velocity_gain(simulation, Weights(plain).settings.gait.period_s), 2)
        simulation.close()
        _write(plain, output, gain)
    finally:
        plain.unlink(missing_ok=True)
    return gain


def _write(weights: Path, output: Path, gain: np.ndarray) -> None:
    """Write weights with another gain of the velocities."""
    _, metadata, _ = read_arrays(weights)
    with np.load(weights, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    metadata["gain"] = [float(value) for value in gain] + metadata.get("gain", [1.0] * 7)[2:]
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    partial = output.with_suffix(".partial.npz")
    np.savez(partial, allow_pickle=False, **arrays)
    partial.replace(output)
