"""A compiled model -> triangles light enough for a headset: one list of vertices and indices, one entry a geom.

What is sent is what is seen: meshes with their vertices clustered, primitives as triangles, each in its body's frame.
Meshes come twice, fine and coarse: a browser that draws in software shows the coarse ones.
"""

import json
from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import Task

SHOWN_GROUPS = 3  # geoms of groups 0, 1 and 2 are seen; the others only collide
CELLS = 14  # cells along a mesh's longest side in which vertices are merged
COARSE_CELLS = 5  # the same where every triangle costs
FINEST_M = 0.006  # smallest cell
ROUND = 20  # sides of a circle
HEAD_BODIES = ("neck_yaw_link", "neck_pitch_link")

Triangles = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices (V, 3) [m], normals (V, 3) and indices (F, 3)."""


@dataclass(frozen=True, kw_only=True)
class ScenePackage:
    """What a page needs to draw a task.

    Attributes:
        description: JSON: bodies' names, and of each geom body, colour, first index, number of indices; of a mesh
            also those of its coarse form.
        buffers: Vertices (V, 6) float32, position and normal, then indices (I,) uint32.
        geoms: Model ids of the geoms, in the order of the description.
        num_triangles: Of the fine forms.
        num_coarse: With meshes in their coarse form.
    """

    description: str
    buffers: bytes
    geoms: tuple[int, ...]
    num_triangles: int
    num_coarse: int


def package(model: mujoco.MjModel, task: Task) -> ScenePackage:
    """Return the geoms of a compiled model as a page draws them."""
    surfaces, entries, geoms = _Surfaces(), [], []
    num_triangles = num_coarse = 0
    for geom in range(model.ngeom):
        rgba = geom_rgba(model, geom)
        unseen = rgba[3] == 0.0 and task.memory is None
        if model.geom_group[geom] >= SHOWN_GROUPS or unseen or model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        T_body_geom = poses.pose(model.geom_pos[geom], model.geom_quat[geom])
        fine = coarse = surfaces.add(triangles(model, geom), T_body_geom)
        entry = {"body": int(model.geom_bodyid[geom]), "rgba": [round(float(value), 3) for value in rgba], **fine}
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            coarse = entry["coarse"] = surfaces.add(triangles(model, geom, COARSE_CELLS), T_body_geom)
        entries.append(entry)
        geoms.append(geom)
        num_triangles += fine["count"] // 3
        num_coarse += coarse["count"] // 3
    description = {
        "bodies": [model.body(index).name for index in range(model.nbody)],
        "head": [index for index in range(model.nbody) if model.body(index).name in HEAD_BODIES],
        "geoms": entries,
        "vertices": surfaces.num_vertices,
        "indices": surfaces.num_indices,
    }
    return ScenePackage(
        description=json.dumps(description),
        buffers=surfaces.buffers(),
        geoms=tuple(geoms),
        num_triangles=num_triangles,
        num_coarse=num_coarse,
    )


class _Surfaces:
    """Triangles of many geoms, in one list of vertices and one of indices."""

    def __init__(self) -> None:
        self._vertices: list[np.ndarray] = []
        self._indices: list[np.ndarray] = []
        self.num_vertices = 0
        self.num_indices = 0

    def add(self, surface: Triangles, T_body_geom: np.ndarray) -> dict[str, int]:
        """Append a surface in its geom's frame; returns its first index and the number of its indices."""
        points, normals, faces = surface
        points, normals = poses.transform(T_body_geom, points), normals @ T_body_geom[:3, :3].T
        self._vertices.append(np.concatenate([points, normals], axis=1))
        self._indices.append(faces.reshape(-1) + self.num_vertices)
        part = {"first": self.num_indices, "count": int(faces.size)}
        self.num_vertices += len(points)
        self.num_indices += faces.size
        return part

    def buffers(self) -> bytes:
        """Return vertices (V, 6) float32, then indices (I,) uint32, both little-endian."""
        vertices, indices = np.concatenate(self._vertices), np.concatenate(self._indices)
        return vertices.astype("<f4").tobytes() + indices.astype("<u4").tobytes()


def geom_rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour (4,) of a geom: its material's where it has one."""
    material = int(model.geom_matid[geom])
    return model.mat_rgba[material].copy() if material >= 0 else model.geom_rgba[geom].copy()


def triangles(model: mujoco.MjModel, geom: int, cells: int = CELLS) -> Triangles:
    """Return the surface of a geom, in the geom's frame; a mesh with so many cells along its longest side."""
    size = model.geom_size[geom]
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]), cells)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _box(size)
    angle = np.linspace(-np.pi / 2, np.pi / 2, ROUND // 2 + 1)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # radius and height of a half circle
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        flat = np.array([[0.0, -1.0], [1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [1.0, 1.0], [0.0, 1.0]])
        slopes = np.array([[0.0, -1.0], [0.0, -1.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
        return _turned(flat * [size[0], size[1]], slopes)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        middle = len(profile) // 2
        doubled = np.concatenate([profile[: middle + 1], profile[middle:]])
        shift = np.repeat([-size[1], size[1]], [middle + 1, len(profile) - middle])
        return _turned(doubled * size[0] + np.stack([np.zeros(len(shift)), shift], axis=1), doubled)
    points, normals, faces = _turned(profile, profile)
    radii = np.full(3, size[0]) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
    normals = normals / radii
    return points * radii, normals / np.linalg.norm(normals, axis=1, keepdims=True), faces


def _box(size: np.ndarray) -> Triangles:
    points, normals, faces = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.zeros(3), np.zeros(3)
            u[(axis + 1) % 3], v[(axis + 2) % 3] = 1.0, sign
            normal = np.zeros(3)
            normal[axis] = sign
            first = len(points)
            points += [(normal + a * u + b * v) * size for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [normal] * 4
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return np.array(points), np.array(normals), np.array(faces)


def _turned(profile: np.ndarray, slopes: np.ndarray) -> Triangles:
    """Return the surface of a profile (P, 2), radius and height, turned about z; slopes (P, 2) are its normals."""
    angle = np.linspace(0.0, 2.0 * np.pi, ROUND, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def swept(values: np.ndarray) -> np.ndarray:
        ring = values[:, None, :1] * around[None]
        return np.concatenate([ring, np.broadcast_to(values[:, None, 1:], (*ring.shape[:2], 1))], axis=2).reshape(-1, 3)

    row, column = np.meshgrid(np.arange(len(profile) - 1), np.arange(ROUND), indexing="ij")
    here, beside = row * ROUND + column, row * ROUND + (column + 1) % ROUND
    above, across = here + ROUND, beside + ROUND
    faces = np.stack([here, beside, across, here, across, above], axis=-1).reshape(-1, 3)
    return swept(profile), swept(slopes), faces


def _mesh(model: mujoco.MjModel, mesh: int, cells: int) -> Triangles:
    """Return a mesh with the vertices in each cell of a grid merged into their mean, and what collapsed left out."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    points = model.mesh_vert[first : first + count].astype(np.float64)
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    faces = model.mesh_face[first : first + count].astype(np.int64)
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # twice the area, along the normal
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    cell = max(FINEST_M, float(np.ptp(points, axis=0).max()) / cells)
    keys = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    # A thin wall has two sides in one cell: vertices whose normals point apart are not merged.
    keys = np.concatenate([keys, np.argmax(np.concatenate([normals, -normals], axis=1), axis=1)[:, None]], axis=1)
    _, group, number = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    merged, merged_normals = np.zeros((len(number), 3)), np.zeros((len(number), 3))
    np.add.at(merged, group, points)
    np.add.at(merged_normals, group, normals)
    merged /= number[:, None]
    lengths = np.linalg.norm(merged_normals, axis=1, keepdims=True)
    merged_normals = np.where(lengths > 1e-12, merged_normals / np.maximum(lengths, 1e-12), [0.0, 0.0, 1.0])
    kept = group[faces]
    kept = kept[(kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])]
    _, chosen = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    used, renumbered = np.unique(kept[np.sort(chosen)], return_inverse=True)
    return merged[used], merged_normals[used], renumbered.reshape(-1, 3)
