"""Worlds of a simulation -> small pictures of their head cameras, drawn as the pictures in datasets are."""

import numpy as np

from gym_demohlm.perception.camera import head_intrinsics
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.simulation import Simulation


class SmallPictures:
    """Draws with clustered meshes, without shadows.

    Args:
        sim: The worlds.
        size: Width and height [px].

    Raises:
        SceneError: This machine has nothing to draw with, or the size is too large.
    """

    def __init__(self, sim: Simulation, size: tuple[int, int]) -> None:
        self._sim = sim
        self._visual = VisualModel(sim.model, head_intrinsics(*size))

    def rgb(self, world: int) -> np.ndarray:
        """Return a world's picture (height, width, 3) uint8."""
        if self._sim.variation:
            self._visual.wear(self._sim.scene.shapes(self._sim.conditions(world)))
        snapshot = self._sim.snapshot(np.array([world]))
        mocap, count = snapshot["mocap"][0], self._sim.model.nmocap
        self._visual.place(self._sim.qpos[world], mocap[: 3 * count].reshape(-1, 3), mocap[3 * count :].reshape(-1, 4))
        if self._sim.task.memory is not None:
            self._sim.task.memory.draw(self._visual.model, snapshot["memory"][0])
        return self._visual.rgb()

    def close(self) -> None:
        """Give the graphics context back."""
        self._visual.close()
