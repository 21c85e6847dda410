"""An episode and its repetition -> the first thing in which they differ, and how far apart they are as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm.envs import observation
from gym_demohlm.simulation.judge import held
from lerobot_demohlm.datasets.reader import ENVIRONMENT_STATE, STATE, StoredEpisode

_ANGLES = np.array([not name.endswith(".vel") for name in observation.STATE_NAMES])


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """How far the repetition of an episode is from what is stored.

    Attributes:
        joints: Largest difference of a joint position or of the torso's tilt [rad].
        positions: Largest difference of an object's position in the camera frame [m].
        rotations: Largest difference of an entry of an object's rotation matrix.
        outcome: Whether it ended as stored: with success held for the last second, or without.
    """

    joints: float = 0.0
    positions: float = 0.0
    rotations: float = 0.0
    outcome: bool = True

    @property
    def within_bounds(self) -> bool:
        """Whether everything is within ``BOUNDS`` and the outcome is the stored one."""
        return self.outcome and all(
            getattr(self, name) <= getattr(BOUNDS, name) for name in ("joints", "positions", "rotations")
        )

    def __str__(self) -> str:
        """Return the numbers in words."""
        end = "ends as stored" if self.outcome else "ends otherwise than stored"
        return f"joints by up to {self.joints:.1e} rad, objects by up to {self.positions:.1e} m, {end}"


BOUNDS = Deviation(joints=0.05, positions=0.03, rotations=0.1)
"""Largest differences of an episode that agrees, under other versions or on another kind of processor.

Joint targets with relative errors of 1e-7 at every tick, as arithmetic that rounds otherwise has, moved 24 episodes of
eight tasks (R3, commands with noise) by up to 0.012 rad, 0.006 m and 0.025. All ended as before."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first thing in which an episode and its repetition differ.

    Attributes:
        episode: Index in the dataset.
        attempt: Index of the attempt in its run.
        step: Frame of the episode: its observation, its action or what the action led to.
        field: "start", "action", "physics", "controller", "contacts", a feature, "outcome" or "digest".
        detail: Both values, where the dataset holds values.
        deviation: Of the whole episode, under versions that may change bits; None where bits must agree.
    """

    episode: int
    attempt: int
    step: int
    field: str
    detail: str = ""
    deviation: Deviation | None = None

    @property
    def within_bounds(self) -> bool:
        """Whether bits may differ and the episode agrees within ``BOUNDS``."""
        return self.deviation is not None and self.deviation.within_bounds

    def __str__(self) -> str:
        """Return the line that is printed."""
        text = f"episode {self.episode} (attempt {self.attempt}) differs at step {self.step}: {self.field}"
        text = f"{text}, {self.detail}" if self.detail else text
        return text if self.deviation is None else f"{text}; {self.deviation}"


def deviation(entry: StoredEpisode, made: dict[str, np.ndarray], success: Sequence[bool] | np.ndarray) -> Deviation:
    """Return how far what was simulated is from an episode as stored.

    Args:
        entry: The episode, T frames.
        made: (T', D) of ``observation.state`` and ``observation.environment_state``, T' at most T.
        success: (T',) whether the task's condition held after each step.
    """
    count = len(success)
    state = np.abs(made[STATE].astype(np.float64) - entry.columns[STATE][:count])[:, _ANGLES]
    objects = np.abs(made[ENVIRONMENT_STATE].astype(np.float64) - entry.columns[ENVIRONMENT_STATE][:count])
    places = objects.reshape(count, -1, 9)  # position, then two columns of the rotation matrix
    as_stored = held(success) == (entry.outcome == "success")
    return Deviation(
        joints=float(state.max(initial=0.0)),
        positions=float(places[..., :3].max(initial=0.0)),
        rotations=float(places[..., 3:].max(initial=0.0)),
        outcome=bool(as_stored and count == len(entry)),
    )
