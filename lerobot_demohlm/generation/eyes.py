"""How generated attempts see objects: exactly, or as a robot's eyes would; what plans their motion sees exactly."""

import numpy as np

from gym_demohlm.envs import observation
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.perception.sight import Sight
from gym_demohlm.simulation import Simulation


def open_sight(sim: Simulation, settings: str | PerceptionSettings) -> Sight | None:
    """Return eyes that are not exact; None for exact ones, whose worlds need none."""
    settings = PerceptionSettings.read(settings)
    return None if settings.is_exact else Sight(sim, settings)


def seen_objects(sim: Simulation, sight: Sight | None) -> np.ndarray:
    """Return the observation of the objects in all worlds (N, 9k) float32: as eyes see them, or exactly without any."""
    return observation.environment_state(sim) if sight is None else sight.environment_state()
