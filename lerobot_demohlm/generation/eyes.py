"""How generated attempts see objects: exactly, or as a robot's eyes would; what plans their motion sees exactly."""

import numpy as np

from gym_demohlm.envs import observation
from gym_demohlm.perception.disturbance import varies
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.perception.sight import Sight
from gym_demohlm.simulation import Simulation
from gym_demohlm.variation import Variation


def open_sight(sim: Simulation, settings: str | PerceptionSettings, variation: Variation | None = None) -> Sight | None:
    """Return eyes that are not exact; None for exact ones, whose worlds need none.

    Args:
        sim: The worlds.
        settings: How they see.
        variation: By which episodes draw how they see; that of the worlds by default.
    """
    settings, variation = PerceptionSettings.read(settings), sim.variation if variation is None else variation
    return None if settings.is_exact and not varies(variation) else Sight(sim, settings, variation)


def seen_objects(sim: Simulation, sight: Sight | None) -> np.ndarray:
    """Return the observation of the objects in all worlds (N, 9k) float32: as eyes see them, or exactly without any."""
    return observation.environment_state(sim) if sight is None else sight.environment_state()
