"""An object's shape and a mask -> poses whose silhouettes lie where the mask does, from which a fit can begin.

Poses are ``T_optical_object`` (4, 4). The image's border may cut a mask off: such an end does not say where the object
is.
"""

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import fit

_OVERLAP = 0.60  # IoU of guess and mask below which the guess is moved
_NEAREST = 0.05  # m from the camera
_ALONG = np.linspace(-0.3, 0.3, 7)  # of its extent, by which an object may lie elsewhere if no edge says where it is


def cut(view: fit.View) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the image's border cuts off the mask's low and high end: (2,) bool each, in x and y."""
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    return view.low + view.window.corner <= 1, view.high + view.window.corner >= size - 2


def is_whole(view: fit.View) -> bool:
    """Return whether the image's border cuts nothing off."""
    return not np.any(cut(view))


def moved_to_mask(shape: fit.Shape, guess: np.ndarray, view: fit.View) -> np.ndarray | None:
    """Return a guess brought over the mask, or None where it is there already."""
    if fit.overlap(shape, guess, view) > _OVERLAP:
        return None
    T = _aligned(shape, guess, view)
    if shape.solid and len(view.points):
        near = np.median(view.points[:, 2])
        expected = float((shape.vertices @ T[2, :3]).min()) + T[2, 3] + 0.3 * shape.radius
        if abs(near - expected) > 0.03:
            T[:3, 3] *= (T[2, 3] + near - expected) / T[2, 3]
    return T


def placed(shape: fit.Shape, R_optical_object: np.ndarray, view: fit.View) -> list[np.ndarray]:
    """Return poses of an orientation whose silhouettes have the place and size of the mask.

    Several where the image's border cuts the object off and no other edge says where it is. The lower end of furniture
    does not: the floor and other things hide it.
    """
    middle = view.intrinsics.unproject((view.low + view.high) / 2.0 + view.window.corner, np.array(1.0))
    turned = (shape.vertices - shape.middle) @ R_optical_object.T
    extent, seen = np.ptp(turned[:, :2], axis=0), np.maximum(view.high - view.low + 1, 1)
    z = float(np.min(view.intrinsics.focal * extent / seen))  # the less hidden way
    if shape.solid and len(view.points):
        z = float(np.median(view.points[:, 2])) - 0.5 * float(turned[:, 2].min())
    T = np.eye(4)
    T[:3, :3] = R_optical_object
    T[:3, 3] = middle * max(z, 2.0 * _NEAREST) - R_optical_object @ shape.middle
    T = _aligned(shape, _aligned(shape, T, view), view)
    cut_low, cut_high = cut(view)
    unsure = cut_low & cut_high | [False, shape.mesh.fixed] & (cut_low | cut_high)
    shifts = [_ALONG * extent[axis] if unsure[axis] else (0.0,) for axis in range(2)]
    return [poses.pose([x, y, 0.0]) @ T for x in shifts[0] for y in shifts[1]]


def _aligned(shape: fit.Shape, T: np.ndarray, view: fit.View) -> np.ndarray:
    """Return a pose moved across the image so that silhouette and mask have the same middle, or the same free edge.

    Where the mask is cut off by the window's border, only its other edge says where the object is.
    """
    p_optical = shape.vertices @ T[:3, :3].T + T[:3, 3]
    p_optical[:, 2] = np.maximum(p_optical[:, 2], _NEAREST)
    uv = view.intrinsics.project(p_optical) - view.window.corner
    low, high = uv.min(axis=0), uv.max(axis=0)
    size = np.array([view.window.width, view.window.height])
    cut_low, cut_high = view.low <= 1, view.high >= size - 2
    shift = (view.low + view.high - low - high) / 2.0
    shift = np.where(cut_low & ~cut_high, view.high - high, shift)
    shift = np.where(cut_high & ~cut_low, view.low - low, shift)
    result = T.copy()
    result[:2, 3] += shift / view.intrinsics.focal * T[2, 3]
    return result
