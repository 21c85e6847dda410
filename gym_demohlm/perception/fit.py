"""Depth, a mask and a first guess -> the pose at which a mesh explains both: Gauss-Newton on two kinds of residuals.

Each depth pixel inside the mask should lie on a face of the mesh that looks at the camera (point to plane). Each point
of the mesh's outline should lie on the mask's edge (point to line), searched along the outline's normal; where
something nearer hides the object, the mask's edge is not the object's and is skipped. All of it is in the frame
``optical``.

A stereo camera's depth is off by a constant factor. The outline tells the size and so the distance, so the factor is a
seventh unknown. What earlier frames told of pose and factor is a prior (``Prior``), as in a Kalman filter.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.camera import Intrinsics, Window
from gym_demohlm.perception.d435 import DepthNoise
from gym_demohlm.perception.meshes import ObjectMesh

MAX_POINTS = 300  # depth pixels of a fit
OUTLINE_POINTS = 120  # about as many points of the outline
_LEAST_POINTS = 30  # fewer depth pixels say nothing
_DEPTH_FLOOR = 0.001  # m, least standard deviation of a depth pixel
_DEPTH_PATCH = 40.0  # px, area over which depth errs one way: several points in it count as one
_OUTLINE_STRETCH = 10.0  # px of the outline over which a mask's edge errs one way
_OUTLINE_SIGMA = 1.0  # px
_OUTLINE_SCALE = 3.0  # px, beyond which an outline's residual counts less
_NEARER = 0.015  # m, of what hides an object
_DAMPING = np.array([20.0] * 3 + [0.55] * 3 + [0.0])  # 1/m^2 and 1/rad^2: pulls an unobservable motion to zero
_CONVERGED = np.array([2e-4] * 3 + [1e-3] * 3 + [1e-3])  # m, rad, 1
_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class View:
    """What a fit looks at.

    Attributes:
        depth: (height, width) float32 of the window [m], 0 where nothing was measured.
        mask: (height, width) uint8 of the window, 1 on the object.
        hiders: (height, width) uint8 of the window, 1 on other known things, or None: the robot, other objects.
        window: Where in the image both lie.
        intrinsics: Of the image.
        points: (n, 3) depth pixels well inside the mask [m].
        sigma: (n,) their standard deviations [m].
        share: How much of an independent measurement each of them is.
        num_pixels: How many pixels the mask has.
        low: (2,) the mask's first column and row in the window; 0 where it is empty.
        high: (2,) its last column and row; -1 where it is empty.
    """

    depth: np.ndarray
    mask: np.ndarray
    hiders: np.ndarray | None
    window: Window
    intrinsics: Intrinsics
    points: np.ndarray
    sigma: np.ndarray
    share: float
    num_pixels: int
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class Prior:
    """What is known before a fit.

    Attributes:
        T: (4, 4) ``T_optical_object``.
        scale: Measured depth over true depth.
        information: (7, 7) inverse covariance of position [m], turn in the frame ``optical`` [rad] and scale.
    """

    T: np.ndarray
    scale: float
    information: np.ndarray


@dataclass(frozen=True)
class Fit:
    """Where a fit ended.

    Attributes:
        T: (4, 4) ``T_optical_object``.
        scale: Measured depth over true depth.
        information: (7, 7) see ``Prior``, with what the frame told.
    """

    T: np.ndarray
    scale: float
    information: np.ndarray


@dataclass(frozen=True)
class Quality:
    """How well a pose explains a view.

    Attributes:
        inliers: Share of the depth pixels that lie on the mesh; 1 where none could.
        iou: Pixels of both silhouette and mask over pixels of either, without what something nearer may hide.
    """

    inliers: float
    iou: float

    @property
    def score(self) -> float:
        """One number to compare poses by."""
        return self.iou + 0.5 * self.inliers


def make_view(
    depth: np.ndarray,
    mask: np.ndarray,
    window: Window,
    intrinsics: Intrinsics,
    noise: DepthNoise,
    hiders: np.ndarray | None = None,
) -> View:
    """Choose the depth pixels of a fit, the same ones for the same images.

    Args:
        depth: (height, width) float32 of the window [m].
        mask: (height, width) bool of the window.
        window: Part of the image.
        intrinsics: Of the image.
        noise: What the camera's noise is taken to be.
        hiders: (height, width) bool of the window, see ``View``.
    """
    mask = np.ascontiguousarray(mask, dtype=np.uint8)
    left, top, width, height = cv2.boundingRect(mask)
    first_column, first_row = max(0, left - 1), max(0, top - 1)  # one pixel more: outside an image nothing is eroded
    near = slice(first_row, top + height + 1), slice(first_column, left + width + 1)
    for reach in (2, 1, 0):  # a mixed pixel at the edge is neither the object nor the background
        square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        inner = cv2.erode(mask[near], square) if reach else mask[near]
        chosen = np.flatnonzero((inner > 0) & (depth[near] > 0))
        if len(chosen) >= MAX_POINTS // 2:
            break
    stride = max(1, len(chosen) // MAX_POINTS)
    rows, columns = np.divmod(chosen[stride // 2 :: stride], inner.shape[1])
    pixels = np.stack([columns + first_column, rows + first_row], axis=1)
    z = depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return View(
        depth=depth,
        mask=mask,
        hiders=None if hiders is None else np.ascontiguousarray(hiders, dtype=np.uint8),
        window=window,
        intrinsics=intrinsics,
        points=intrinsics.unproject(pixels + window.corner, z),
        sigma=np.maximum(noise.sigma(z), _DEPTH_FLOOR),
        share=min(1.0, stride / _DEPTH_PATCH),
        num_pixels=int(np.count_nonzero(mask)),
        low=np.array([left, top]),
        high=np.array([left + width - 1, top + height - 1]),
    )


class Shape:
    """A mesh's parts as arrays, for fits; see ``ObjectMesh``."""

    def __init__(self, mesh: ObjectMesh) -> None:
        self.mesh = mesh
        parts = mesh.parts
        self.vertices = mesh.vertices
        self.normals = np.concatenate([part.normals for part in parts])
        self.offsets = np.concatenate([part.offsets for part in parts])
        num_faces = [len(part.normals) for part in parts]
        num_vertices = [len(part.vertices) for part in parts]
        self.first_face = np.cumsum([0, *num_faces[:-1]])
        first_vertex = np.cumsum([0, *num_vertices[:-1]])
        self.face_part = np.repeat(np.arange(len(parts)), num_faces)
        self.edges = np.concatenate([part.edges + first for part, first in zip(parts, first_vertex, strict=True)])
        self.edge_faces = np.concatenate(
            [part.edge_faces + first for part, first in zip(parts, self.first_face, strict=True)]
        )
        self.edge_part = np.repeat(np.arange(len(parts)), [len(part.edges) for part in parts])
        self.middles = np.array([part.vertices.mean(axis=0) for part in parts])
        self.part_vertices = [
            slice(int(first), int(first) + count) for first, count in zip(first_vertex, num_vertices, strict=True)
        ]
        self.opaque_faces = np.repeat([part.opaque for part in parts], num_faces)
        self.radius = float(np.linalg.norm(self.vertices - self.vertices.mean(axis=0), axis=1).max())
        self.middle = self.vertices.mean(axis=0)
        self.solid = bool(self.opaque_faces.any())


def silhouette(shape: Shape, T: np.ndarray, intrinsics: Intrinsics, window: Window) -> np.ndarray:
    """Return the pixels (height, width) uint8 of a window that the mesh at ``T_optical_object`` covers."""
    image = np.zeros((window.height, window.width), np.uint8)
    p_optical = shape.vertices @ T[:3, :3].T + T[:3, 3]
    if p_optical[:, 2].min() < 0.05:
        return image
    uv = intrinsics.project(p_optical) - window.corner
    fixed = np.clip(np.round(uv * (1 << _SUBPIXEL_BITS)), -(2**20), 2**20).astype(np.int32)
    for part in shape.part_vertices:
        cv2.fillConvexPoly(image, cv2.convexHull(fixed[part]), 1, lineType=cv2.LINE_8, shift=_SUBPIXEL_BITS)
    return image


def overlap(shape: Shape, T: np.ndarray, view: View) -> float:
    """Return pixels of both silhouette and mask over pixels of either, without those that something nearer hides."""
    drawn = silhouette(shape, T, view.intrinsics, view.window)
    nearest = float((shape.vertices @ T[2, :3]).min() + T[2, 3])
    hidden = (view.depth > 0) & (view.depth < nearest - _NEARER)
    if view.hiders is not None:
        hidden |= view.hiders > 0
    both = np.count_nonzero(drawn & view.mask)
    return both / max(1, np.count_nonzero((drawn > 0) & ~hidden | (view.mask > 0)))


def assess(shape: Shape, T: np.ndarray, view: View, scale: float = 1.0) -> Quality:
    """Return how well the mesh at ``T_optical_object`` explains a view."""
    drawn = silhouette(shape, T, view.intrinsics, view.window)
    deepest = float((shape.vertices @ T[2, :3]).max() + T[2, 3])
    outside = (drawn > view.mask) & (view.depth > deepest + 0.03)  # it should hide what is seen there
    both = int(np.count_nonzero(drawn & view.mask))
    iou = both / max(1, view.num_pixels + int(np.count_nonzero(outside)))
    inliers = 1.0
    if shape.solid and len(view.points) >= _LEAST_POINTS:
        residual, _ = _depth_residuals(shape, T, scale, view)
        inliers = float(np.mean(np.abs(residual) < 3.0 * view.sigma + 0.003))
    return Quality(inliers, iou)


def fit(shape: Shape, guess: np.ndarray, view: View, prior: Prior, iterations: int, reach: int = 20) -> Fit:
    """Return the pose near a first guess that explains a view and what was known best.

    Args:
        shape: The object.
        guess: (4, 4) ``T_optical_object`` to start from.
        view: Depth and mask.
        prior: What is known.
        iterations: Largest number of Gauss-Newton steps.
        reach: How far the mask's edge is searched at first [px].
    """
    T, scale = guess.copy(), prior.scale
    H = prior.information
    for iteration in range(iterations):
        early = iteration < 2
        H, g = prior.information.copy(), prior.information @ _apart(T, scale, prior)
        _add_depth(shape, T, scale, view, 0.06 if early else 0.02, H, g)
        _add_outline(shape, T, view, reach if early else 8, H, g)
        step = -np.linalg.solve(H + np.diag(_DAMPING), g)
        step[3:6] *= min(1.0, 0.5 / max(float(np.linalg.norm(step[3:6])), 1e-9))
        T[:3, 3] += step[:3]
        T[:3, :3] = poses.rotation_from_vector(step[3:6]) @ T[:3, :3]
        scale += step[6]
        T[2, 3] = max(T[2, 3], 0.05)
        if iteration >= 2 and (np.abs(step) < _CONVERGED).all():
            break
    return Fit(T, float(scale), H)


def surprise(result: Fit, prior: Prior) -> float:
    """Return the squared deviation of a fit from what was known, in units of what was allowed for."""
    apart = _apart(result.T, result.scale, prior)
    return float(apart @ prior.information @ apart)


def _apart(T: np.ndarray, scale: float, prior: Prior) -> np.ndarray:
    """Return position [m], turn [rad] and scale (7,) from a prior's."""
    turn = poses.rotation_vector(T[:3, :3] @ prior.T[:3, :3].T)
    return np.concatenate([T[:3, 3] - prior.T[:3, 3], turn, [scale - prior.scale]])


def _depth_residuals(shape: Shape, T: np.ndarray, scale: float, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distances (n,) of depth pixels from the mesh [m], and the index of each one's face."""
    R, t = T[:3, :3], T[:3, 3]
    distance = ((view.points / scale - t) @ R) @ shape.normals.T - shape.offsets
    front = shape.normals @ -(t @ R) > shape.offsets
    if len(shape.part_vertices) > 1:
        of_part = np.maximum.reduceat(distance, shape.first_face, axis=1)
        nearest = np.abs(of_part).argmin(axis=1)
        distance = np.where((shape.face_part == nearest[:, None]) & front, distance, -np.inf)
    else:
        distance = np.where(front, distance, -np.inf)
    face = distance.argmax(axis=1)
    return distance[np.arange(len(face)), face], face


def _add_depth(
    shape: Shape, T: np.ndarray, scale: float, view: View, gate: float, H: np.ndarray, g: np.ndarray
) -> None:
    """Add the normal equations of the depth pixels within a gate [m]."""
    if not shape.solid or len(view.points) < _LEAST_POINTS:
        return
    residual, face = _depth_residuals(shape, T, scale, view)
    points = view.points / scale
    normals = shape.normals[face] @ T[:3, :3].T
    weight = view.share / (view.sigma**2 * (1.0 + (residual / (2.0 * view.sigma)) ** 2))
    weight *= (np.abs(residual) < gate) & shape.opaque_faces[face]
    residual = np.where(weight > 0, residual, 0.0)
    along_ray = (normals * points).sum(axis=1, keepdims=True) / scale
    J = -np.concatenate([normals, np.cross(points - T[:3, 3], normals), along_ray], axis=1)
    H += (J * weight[:, None]).T @ J
    g += J.T @ (weight * residual)


def _add_outline(shape: Shape, T: np.ndarray, view: View, reach: int, H: np.ndarray, g: np.ndarray) -> None:
    """Add the normal equations of the outline's points, whose edge of the mask is searched within a reach [px]."""
    p_optical, uv, outward, share = _outline(shape, T, view)
    if len(uv) == 0:
        return
    focal = view.intrinsics.focal
    height, width = view.mask.shape
    steps = np.arange(-reach, reach + 1)
    local = uv - view.window.corner
    columns = np.rint(local[:, :1] + steps * outward[:, :1]).astype(np.int64)
    rows = np.rint(local[:, 1:] + steps * outward[:, 1:]).astype(np.int64)
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    index = np.clip(rows, 0, height - 1) * width + np.clip(columns, 0, width - 1)
    on = (view.mask.reshape(-1)[index] > 0) & inside
    edge = on[:, :-1] & ~on[:, 1:] & inside[:, 1:]
    best = np.where(edge, np.abs(steps[:-1] + 0.5), np.inf).argmin(axis=1)
    found = edge.any(axis=1)
    beyond = np.minimum(best[:, None] + np.arange(1, 7), len(steps) - 1)
    outside = np.take_along_axis(index, beyond, axis=1)
    z, own = view.depth.reshape(-1)[outside], p_optical[:, 2:]
    hidden = ((z > 0) & (z < own - _NEARER))[:, 1:].any(axis=1)
    if view.hiders is not None:  # where they touch, depth cannot tell which is in front
        hidden |= ((view.hiders.reshape(-1)[outside] > 0) & (z < own + _NEARER))[:, :4].any(axis=1)
    used = found & ~hidden
    if np.count_nonzero(used) < 5:
        return
    residual = -(steps[best[used]] + 0.5)
    x, y, z = p_optical[used].T
    du, dv = outward[used].T * (focal / z)
    gradient = np.stack([du, dv, -(du * x + dv * y) / z], axis=1)  # of the residual by the point
    J = np.concatenate([gradient, np.cross(p_optical[used] - T[:3, 3], gradient)], axis=1)
    weight = share / (_OUTLINE_SIGMA**2 * (1.0 + (residual / _OUTLINE_SCALE) ** 2))
    H[:6, :6] += (J * weight[:, None]).T @ J
    g[:6] += J.T @ (weight * residual)


def _outline(shape: Shape, T: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return points of the outline.

    Returns:
        The points in the frame ``optical`` (n, 3) [m], their pixels (n, 2), outward normals (n, 2), and how much of an
        independent measurement each point is.
    """
    nothing = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), 0.0
    R, t = T[:3, :3], T[:3, 3]
    front = shape.normals @ -(t @ R) > shape.offsets
    chosen = np.flatnonzero(front[shape.edge_faces[:, 0]] != front[shape.edge_faces[:, 1]])
    corners = shape.vertices @ R.T + t
    if len(chosen) == 0 or corners[:, 2].min() < 0.05:
        return nothing
    uv_corners = view.intrinsics.project(corners)
    ends = shape.edges[chosen]
    lengths = np.linalg.norm(uv_corners[ends[:, 1]] - uv_corners[ends[:, 0]], axis=1)
    counts = np.maximum(1, np.rint(lengths / max(float(lengths.sum()), 1e-9) * OUTLINE_POINTS)).astype(np.int64)
    share = min(1.0, float(lengths.sum() / counts.sum()) / _OUTLINE_STRETCH)
    edge = np.repeat(np.arange(len(chosen)), counts)
    place = (np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge]
    first, last = corners[ends[edge, 0]], corners[ends[edge, 1]]
    p_optical = first + place[:, None] * (last - first)
    uv = view.intrinsics.project(p_optical)
    along = uv_corners[ends[edge, 1]] - uv_corners[ends[edge, 0]]
    outward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-9
    uv_middles = view.intrinsics.project(shape.middles @ R.T + t)
    inward = ((uv - uv_middles[shape.edge_part[chosen[edge]]]) * outward).sum(axis=1) < 0
    outward[inward] *= -1.0
    if len(shape.part_vertices) > 1:  # an edge of one part may lie before or behind another part
        drawn = silhouette(shape, T, view.intrinsics, view.window)
        ahead = np.rint(uv + 2.5 * outward - view.window.corner).astype(np.int64)
        within = ((ahead >= 0) & (ahead < [view.window.width, view.window.height])).all(axis=1)
        ahead = np.clip(ahead, 0, [view.window.width - 1, view.window.height - 1])
        outer = within & (drawn[ahead[:, 1], ahead[:, 0]] == 0)
        return p_optical[outer], uv[outer], outward[outer], share
    return p_optical, uv, outward, share
