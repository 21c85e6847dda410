"""Where camera, hands and objects are -> about how much of each object the camera sees, without drawing.

An object is some points of its shape. A point is seen where it lies in the picture and no hand, taken as
spheres, lies on the way to it. Other things that hide an object are left out.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import camera
from gym_demohlm.perception.meshes import known_meshes
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation

_POINTS = 16  # of each object
_RADIUS = 0.045  # m, of the spheres: half a hand's width
_ROUGH = 0.01  # share of what is in the picture that is seen at least: spheres cannot tell that a hand hides all of it
_ALONG = (0.0, 0.5, 1.0)  # of the way from palm to wrist, where the spheres are


class Visibility:
    """Tells visible shares in the worlds of a simulation.

    Args:
        sim: Of whose task the objects are.
    """

    def __init__(self, sim: Simulation) -> None:
        self._points = np.stack([_spread(mesh.vertices) for mesh in known_meshes(sim.scene)])  # (k, p, 3)
        self._intrinsics = camera.head_intrinsics()

    def shares(self, sim: Simulation, rows: np.ndarray, T_camera_object: np.ndarray) -> np.ndarray:
        """Return the visible share (n, k) of each object.

        Args:
            sim: The worlds.
            rows: (n,) which of them.
            T_camera_object: (n, k, 4, 4) where the objects are in the frame ``head_camera``.
        """
        T = camera.T_OPTICAL_CAMERA @ T_camera_object
        p = (T[:, :, None, :3, :3] * self._points[:, :, None, :]).sum(axis=-1) + T[..., None, :3, 3]
        depth = p[..., 2]
        in_front = depth > 0.05
        uv = self._intrinsics.project(np.where(in_front[..., None], p, 1.0))
        size = np.array([self._intrinsics.width, self._intrinsics.height])
        seen = in_front & ((uv >= 0) & (uv <= size - 1)).all(axis=-1)
        spheres = self._spheres(sim, rows)  # (n, s, 3)
        length = np.linalg.norm(p, axis=-1)
        along = np.einsum("nkpi,nsi->nkps", p, spheres) / length[..., None]
        aside = (spheres**2).sum(axis=-1)[:, None, None] - along**2  # squared distance of each sphere from each ray
        hidden = (aside < _RADIUS**2) & (along > 0.05) & (along < length[..., None] - 0.01)
        shown = (seen & ~hidden.any(axis=-1)).mean(axis=-1)
        return np.maximum(shown, _ROUGH * seen.mean(axis=-1))

    def _spheres(self, sim: Simulation, rows: np.ndarray) -> np.ndarray:
        """Return the middles (n, s, 3) of what may hide an object, in the frame ``optical``."""
        T_optical_world = camera.T_OPTICAL_CAMERA @ poses.invert(sim.pose("head_camera")[rows])
        found = []
        for side in g1.SIDES:
            palm, wrist = (sim.pose(name)[rows, :3, 3] for name in (f"{side}_palm", f"{side}_wrist_yaw_link"))
            found += [palm + share * (wrist - palm) for share in _ALONG]
        middles = np.stack(found, axis=1)
        return np.einsum("nij,nsj->nsi", T_optical_world[:, :3, :3], middles) + T_optical_world[:, None, :3, 3]


def _spread(vertices: np.ndarray) -> np.ndarray:
    """Return points (p, 3) that spread over a shape: each the farthest from those before it."""
    chosen = [vertices.mean(axis=0)]
    for _ in range(_POINTS - 1):
        apart = np.min([np.linalg.norm(vertices - point, axis=1) for point in chosen], axis=0)
        chosen.append(vertices[int(np.argmax(apart))])
    return np.array(chosen)
