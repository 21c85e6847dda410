"""What a person sees -> the poses of head and wrists that the robot should take: the border to a headset.

A headset's driver implements ``Operator``; so do the scripted operators in ``scripts/``, which stand in for a person
and are not one: they know where everything is and repeat their motion exactly.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np


@dataclass(frozen=True, kw_only=True)
class SceneView:
    """What an operator sees, as poses in the world.

    Attributes:
        tick: Ticks of 0.1 s since the operator took over.
        T_world_head: (4, 4) head camera.
        T_world_pelvis: (4, 4).
        T_world_hands: (2, 4, 4) left and right palm.
        T_world_objects: Tracked objects by name, (4, 4) each.
        T_world_targets: (2, 4, 4) what is asked of the palms now, which the page draws; None where that is what the
            operator asked for last.
    """

    tick: int
    T_world_head: np.ndarray
    T_world_pelvis: np.ndarray
    T_world_hands: np.ndarray
    T_world_objects: Mapping[str, np.ndarray]
    T_world_targets: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class OperatorPoses:
    """Where an operator's head and hands are, in the robot's world.

    Attributes:
        T_world_head: (4, 4) x forward, y left, z up; the torso follows its position, the neck looks where the gaze
            controller turns it. None leaves the torso to the hands alone.
        T_world_hands: (2, 4, 4) left and right palm.
        grippers: (2,) 0 open .. 1 closed.
        velocity: (3,) that the base should walk with [m/s, m/s, rad/s]; it stands by default.
    """

    T_world_head: np.ndarray | None
    T_world_hands: np.ndarray
    grippers: np.ndarray
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))


class Operator(Protocol):
    """Somebody, or something, that moves head and hands."""

    name: str
    """Written into the demonstration: who recorded it."""

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick; None once the demonstration is over."""
        ...
