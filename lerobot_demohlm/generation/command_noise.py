"""Seed and index of an attempt -> small errors that its executed commands carry and its recorded ones do not (DART).

An episode without errors does not show a policy how to make up for its own. So commands are disturbed on their way to
the controller, and the episode holds what was planned from where that led (Laskey et al. 2017). Noise comes in bursts
with pauses between them: a pause is the recovery from the burst before it.

Only the walk, which steers by where the base is measured, is disturbed in full. Hands on their way to an object steer
too, but beside things that they must not strike: half of the noise. Once they hold it, nothing measures how it lies in
them, so no plan would make up for its slip: a quarter. There is none about touches and about grippers that close or
open (``Playback.delicate``), and a robot that stands is not told to step.
"""

from collections.abc import Iterator

import numpy as np

from gym_demohlm.control import command
from lerobot_demohlm.generation.stages import LOCOMOTION, MANIPULATION, PRE_MANIPULATION

NOISE_STREAM = 1  # first number of its seed sequences, as GENERATION_STREAM is of initial states
SHORTEST, LONGEST = 3, 8  # ticks of a burst and of a pause: the controller filters shorter ones out
LARGEST = 2.0  # standard deviations
SHARES = {LOCOMOTION: 1.0, PRE_MANIPULATION: 0.5, MANIPULATION: 0.25}

DEVIATIONS = np.zeros(command.SIZE)  # standard deviations at scale 1; none of the grippers
DEVIATIONS[command.VELOCITY] = 0.05  # m/s, m/s, rad/s
DEVIATIONS[command.HEIGHT] = 0.01  # m
DEVIATIONS[[command.ROLL, command.PITCH, command.YAW]] = 0.02  # rad
DEVIATIONS[command.ARMS] = 0.025  # rad, some 2 cm at the palm
DEVIATIONS.setflags(write=False)


def bursts(seed: int, index: int) -> Iterator[np.ndarray]:
    """Yield the noise (23,) of each tick of attempt ``index`` of run ``seed``: constant in a burst, zero in a pause."""
    rng = np.random.default_rng([NOISE_STREAM, seed, index])
    while True:
        burst = DEVIATIONS * np.clip(rng.standard_normal(command.SIZE), -LARGEST, LARGEST)
        for noise in (burst, np.zeros(command.SIZE)):
            for _ in range(rng.integers(SHORTEST, LONGEST + 1)):
                yield noise


def disturbed(planned: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the command (23,) float32 that is executed: inside the bounds, and standing where it was to stand."""
    noise = noise.copy()
    if not planned[command.VELOCITY].any():
        noise[command.VELOCITY] = 0.0
    executed = command.clip((planned + noise)[None])[0][0].astype(np.float32)
    return np.where(noise == 0.0, planned, executed)  # to the bit, the sign of a zero included
