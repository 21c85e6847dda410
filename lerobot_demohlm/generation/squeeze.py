"""The measured force of two palms on the thing between them -> palm targets that press harder where it is too weak.

A demonstration holds its own thing in its own world: pushing the palms as far into the sides of one that is smaller,
heavier or smoother is not enough. Where worlds vary, the force of the demonstrated grip is measured, and the palms are
brought together until they press on the thing here with a multiple of it.
"""

import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.generation.world_view import WorldView

_PRESSED_M = 0.01  # palms press where their targets are closer together than the palms themselves by more than this
_YIELD_M = 0.0003  # inwards for each newton that lacks, in a tick; a palm yields by about 1 mm a newton
_OPEN_M = 0.01  # outwards in each tick once the demonstration lets go


class Squeeze:
    """The grip of one world's two palms.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        share: Force to press with, as a multiple of the demonstrated one; 0 repeats the demonstrated motion.
        max_inwards_m: Largest distance by which a palm's target is moved [m].
    """

    def __init__(
        self, world: WorldView, task: Task, demonstration: Demonstration, share: float, max_inwards_m: float
    ) -> None:
        self._world, self._max_inwards = world, max_inwards_m
        self._object, self._grips = _demonstrated_grip(task, demonstration)
        forces = demonstration.contact_forces[self._grips]
        columns = [task.contact_pairs.index((side, self._object)) for side in g1.SIDES] if self._object else []
        self._wanted = share * float(np.median(forces[:, columns])) if self._grips.any() else 0.0  # N
        self._inwards = 0.0  # m

    def tighten(self, targets: np.ndarray, tick: int) -> np.ndarray:
        """Return targets (2, 4, 4) of the palms that press hard enough; those that hold nothing stay as they are.

        Args:
            targets: (2, 4, 4) as carried over from the demonstration.
            tick: Of the demonstration.
        """
        if self._wanted <= 0.0:
            return targets
        if self._grips[tick]:
            force = min(self._world.contact_force(side, str(self._object)) for side in g1.SIDES)
            self._inwards += _YIELD_M * (self._wanted - force)
        else:
            self._inwards -= _OPEN_M
        self._inwards = min(max(self._inwards, 0.0), self._max_inwards)
        across = targets[0, :3, 3] - targets[1, :3, 3]
        across = across / max(float(norm(across)), 1e-9)
        moved = targets.copy()
        moved[0, :3, 3] -= self._inwards * across
        moved[1, :3, 3] += self._inwards * across
        return moved


def _demonstrated_grip(task: Task, demonstration: Demonstration) -> tuple[str | None, np.ndarray]:
    """Return the object that both palms of a demonstration press on from two sides, and at which ticks (T,) bool.

    Grippers hold things by their jaws; that two of them meet at a cube is no grip of the palms.
    """
    gap = norm(demonstration.T_world_hands[:, 0, :3, 3] - demonstration.T_world_hands[:, 1, :3, 3])
    asked = norm(demonstration.T_world_targets[:, 0, :3, 3] - demonstration.T_world_targets[:, 1, :3, 3])
    for entry in task.objects if task.hands == "rubber" else ():
        pairs = [(side, entry.name) for side in g1.SIDES]
        if all(pair in task.contact_pairs for pair in pairs):
            forces = demonstration.contact_forces[:, [task.contact_pairs.index(pair) for pair in pairs]]
            grips = (forces >= CONTACT_FORCE_N).all(axis=1) & (gap - asked > _PRESSED_M)
            if grips.any():
                return entry.name, grips
    return None, np.zeros(len(demonstration), dtype=bool)
