"""MuJoCo data -> images from the scene's cameras, made when first asked for, and a window for people."""

from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np

from gym_demohlm.errors import SceneError

WIDTH, HEIGHT = 640, 480  # px, the D435's stream


class Renderer:
    """Draws a model's data off screen; the graphics context is made at the first image.

    Args:
        model: The compiled scene.
        width: [px].
        height: [px].
        shadows: Drawn shadows; in software they cost several times the rest.
    """

    def __init__(self, model: mujoco.MjModel, width: int = WIDTH, height: int = HEIGHT, shadows: bool = False) -> None:
        limit = model.vis.global_
        if not (0 < width <= limit.offwidth and 0 < height <= limit.offheight):
            raise SceneError(
                f"an image of {width}x{height}", f"at most {limit.offwidth}x{limit.offheight}", "ask for a smaller one"
            )
        self._model, self._size, self._shadows = model, (height, width), shadows
        self._renderer: mujoco.Renderer | None = None

    def render(self, data: mujoco.MjData, camera: str | mujoco.MjvCamera = "overview") -> np.ndarray:
        """Return an image (height, width, 3) uint8.

        Args:
            data: Of this model, with its kinematics done.
            camera: "overview", "head" for what the robot sees, or a camera of one's own.

        Raises:
            SceneError: This machine has nothing to draw with.
        """
        if self._renderer is None:
            self._renderer = self._open()
        self._renderer.update_scene(data, camera=camera)
        return self._renderer.render().copy()

    def _open(self) -> mujoco.Renderer:
        try:
            renderer = mujoco.Renderer(self._model, *self._size)
        except Exception as error:  # each backend fails in its own way
            raise SceneError(
                f"no graphics to draw with ({error})",
                "EGL or OSMesa",
                "install them (Debian: libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl",
            ) from error
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        return renderer

    def close(self) -> None:
        """Give the graphics context back."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Window:
    """MuJoCo's viewer showing one world, opened at the first ``show``; needs a display."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._viewer: Any = None

    def show(self, data: mujoco.MjData) -> None:
        """Bring the window to the state of data."""
        import mujoco.viewer  # loads the window system, which a machine without a display lacks

        if self._viewer is None:
            self._viewer = mujoco.viewer.launch_passive(self._model, self._data)
        with self._viewer.lock():
            mujoco.mj_copyData(self._data, self._model, data)
        self._viewer.sync()

    def close(self) -> None:
        """Close the window."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
