"""A drawn frame with glass in it -> the depth behind the glass, which a depth camera measures in part."""

import numpy as np

from gym_demohlm.perception import camera
from gym_demohlm.perception.meshes import TRANSPARENT
from gym_demohlm.perception.visual_model import Frame, VisualModel


class Glass:
    """The transparent geoms of a scene.

    Args:
        visual: Draws the scene.
    """

    def __init__(self, visual: VisualModel) -> None:
        alpha = visual.model.geom_rgba[:, 3]
        self._visual = visual
        self._is_glass = np.append(visual.drawn & (alpha > 0) & (alpha < TRANSPARENT), False)  # the last: id -1
        self._geoms = np.flatnonzero(self._is_glass)

    def behind(self, frame: Frame) -> np.ndarray | None:
        """Return the depth (height, width) [m] of a frame's window without glass; None where the scene has none."""
        if not len(self._geoms):
            return None
        behind = frame.depth.copy()  # where no glass is in the picture all is as it is drawn
        window = camera.window_of(self._is_glass[frame.ids], frame.window)
        if window is not None:
            behind[window.slices_in(frame.window)] = self._visual.depth_and_ids(window, self._geoms).depth
        return behind
