"""A compiled model -> how large its geoms are and where they sit on their bodies: what differs when it is drawn."""

from dataclasses import dataclass
from typing import Self

import mujoco
import numpy as np


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """Sizes and places of the geoms of a model.

    Attributes:
        geom_size: (ngeom, 3) as MuJoCo has them for each type [m].
        geom_pos: (ngeom, 3) in the body's frame [m].
        geom_rbound: (ngeom,) radius of the bounding sphere [m].
        geom_aabb: (ngeom, 6) middle and half lengths of the bounding box [m].
    """

    geom_size: np.ndarray
    geom_pos: np.ndarray
    geom_rbound: np.ndarray
    geom_aabb: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Self:
        """Return those of a model."""
        return cls(**{name: getattr(model, name).copy() for name in cls.__dataclass_fields__})

    def put_on(self, model: mujoco.MjModel, geoms: np.ndarray | slice = slice(None)) -> None:
        """Give them to a model, to draw it.

        Args:
            model: It is changed.
            geoms: (ngeom,) which of its geoms they are of; all by default.
        """
        for name in self.__dataclass_fields__:
            getattr(model, name)[geoms] = getattr(self, name)
