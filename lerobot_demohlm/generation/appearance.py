"""An episode's seed -> how its pictures look: light, colours, and where the head camera sits; then back as it was."""

import math
from types import TracebackType
from typing import Self

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.meshes import object_meshes
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.task import Task
from lerobot_demohlm.datasets.cameras import PictureFacts

_CAMERA_SHIFT, _CAMERA_TURN = 0.01, math.radians(2.0)  # m and rad, standard deviations at 1
_BRIGHTNESS, _TINT, _LIGHT_SHIFT = 0.35, 0.10, 0.8  # share, share, m
_COLOUR = 0.25  # share of each channel


class Appearance:
    """A context in which a scene looks as one episode has it.

    Args:
        visual: The drawn scene; it looks as before afterwards.
        task: Whose tracked objects keep their colours.
        facts: By how much pictures vary.
        rng: Of the episode; the same numbers are drawn whatever varies.
    """

    def __init__(self, visual: VisualModel, task: Task, facts: PictureFacts, rng: np.random.Generator) -> None:
        self._model, self._task, self._facts, self._rng = visual.model, task, facts, rng
        self._visual = visual

    def __enter__(self) -> Self:
        model, facts, rng = self._model, self._facts, self._rng
        self._before = {name: getattr(model, name).copy() for name in _names()}
        head = model.vis.headlight
        self._headlight = head.diffuse.copy(), head.ambient.copy()
        brightness, tint = rng.standard_normal(2), rng.standard_normal((2, 3))
        moved, colours = rng.standard_normal(model.light_pos.shape), rng.standard_normal(model.geom_rgba.shape)[:, :3]
        materials, shift, turn = rng.standard_normal(model.mat_rgba.shape)[:, :3], *rng.standard_normal((2, 3))
        if facts.light > 0:
            gains = np.exp(facts.light * (_BRIGHTNESS * brightness[:, None] + _TINT * tint))
            head.diffuse[:], head.ambient[:] = head.diffuse * gains[0], head.ambient * gains[0]
            model.light_diffuse[:] = np.clip(model.light_diffuse * gains[1], 0.0, 1.0)
            model.light_pos[:] += facts.light * _LIGHT_SHIFT * moved
        if facts.texture > 0:
            kept = [geom for mesh in object_meshes(model, self._task) for geom in mesh.geoms]
            gains = np.exp(facts.texture * _COLOUR * colours)
            gains[kept] = 1.0
            model.geom_rgba[:, :3] = np.clip(model.geom_rgba[:, :3] * gains, 0.0, 1.0)
            worn = {int(model.geom_matid[geom]) for geom in kept}
            gains = np.exp(facts.texture * _COLOUR * materials)
            gains[[material for material in worn if material >= 0]] = 1.0
            model.mat_rgba[:, :3] = np.clip(model.mat_rgba[:, :3] * gains, 0.0, 1.0)
        if facts.camera_shift > 0:
            camera = model.camera("head").id
            R = poses.rotation_from_vector(facts.camera_shift * _CAMERA_TURN * turn)
            T = poses.pose(model.cam_pos[camera], model.cam_quat[camera])
            T = T @ poses.from_rotation(R, facts.camera_shift * _CAMERA_SHIFT * shift)
            model.cam_pos[camera], model.cam_quat[camera] = poses.split(T)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name, values in self._before.items():
            getattr(self._model, name)[:] = values
        head = self._model.vis.headlight
        head.diffuse[:], head.ambient[:] = self._headlight


def _names() -> tuple[str, ...]:
    return "geom_rgba", "mat_rgba", "light_diffuse", "light_pos", "cam_pos", "cam_quat"
