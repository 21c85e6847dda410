"""A task's tracked objects -> convex parts that a tracker can fit: the geoms of the compiled scene that are seen.

An object's shape is that of its body and of what is fixed to it. A thin bar's turn about its own axis cannot be seen;
so a bar that is part of a larger rigid thing, as a handle is of a door, is tracked by that whole thing.
"""

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.scene import Scene
from gym_demohlm.task import ObjectSpec, Task
from gym_demohlm.variation import Conditions

SLICES = 28  # sides of a round part, as many as MuJoCo draws
TRANSPARENT = 0.5  # a part whose alpha is below is seen through by a depth camera
_SEEN_GROUPS = 3  # MuJoCo draws geom groups 0, 1 and 2
_THIN = 0.4  # second largest to largest spread of a bar
_SMALL = 0.1  # parts smaller than this share of the whole are left out
_PLANE_DIGITS = 5


@dataclass(frozen=True)
class Part:
    """A convex polyhedron in the object's frame.

    Attributes:
        vertices: (v, 3) [m].
        normals: (f, 3) outward normals of its faces.
        offsets: (f,) distances of the faces from the origin along their normals [m].
        edges: (e, 2) indices of the vertices at the ends of each edge.
        edge_faces: (e, 2) indices of the faces that meet there.
        opaque: Whether a depth camera sees it.
    """

    vertices: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    edges: np.ndarray
    edge_faces: np.ndarray
    opaque: bool = True

    def scaled(self, factor: float) -> "Part":
        """Return the same part with all lengths multiplied."""
        return Part(
            self.vertices * factor, self.normals, self.offsets * factor, self.edges, self.edge_faces, self.opaque
        )


@dataclass(frozen=True, kw_only=True)
class ObjectMesh:
    """The shape of a tracked object in the frame of its body.

    Attributes:
        name: Of the object.
        parts: Convex parts, whose union is the shape.
        geoms: Ids of the geoms that are its pixels in an image.
        colors: (n, 3) colours of the parts, 0 to 1.
        symmetries: (s, 3, 3) rotations among the 24 of a cube after which the shape's convex hull looks the same, the
            identity first.
        spec: The task's entry of the object.
        fixed: Whether it is furniture, or fixed to furniture, which stays where it stands.
    """

    name: str
    parts: tuple[Part, ...]
    geoms: tuple[int, ...]
    colors: np.ndarray
    symmetries: np.ndarray
    spec: ObjectSpec
    fixed: bool

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) of all parts [m]."""
        return np.concatenate([part.vertices for part in self.parts])

    def scaled(self, factor: float) -> "ObjectMesh":
        """Return a mesh that is too large or small by a factor, as a scan may be."""
        parts = tuple(part.scaled(factor) for part in self.parts)
        return ObjectMesh(
            name=self.name,
            parts=parts,
            geoms=self.geoms,
            colors=self.colors,
            symmetries=self.symmetries,
            spec=self.spec,
            fixed=self.fixed,
        )


def known_meshes(scene: Scene) -> tuple[ObjectMesh, ...]:
    """Return the shapes that a robot knows of a scene's tracked objects: the plain ones, whatever its worlds have.

    Raises:
        SceneError: An object has nothing that is seen.
    """
    if not scene.variation:
        return object_meshes(scene.model, scene.task)
    model = copy.copy(scene.model)  # which may be dressed as one of the worlds
    scene.shapes(Conditions()).put_on(model)
    return object_meshes(model, scene.task)


def object_meshes(model: mujoco.MjModel, task: Task) -> tuple[ObjectMesh, ...]:
    """Return the shapes of a task's tracked objects, in their order.

    Raises:
        SceneError: An object has nothing that is seen.
    """
    return tuple(_object_mesh(model, entry) for entry in task.objects)


def convex_part(points: np.ndarray, opaque: bool = True) -> Part:
    """Return the convex hull of points (n, 3) [m], its triangles merged into flat faces."""
    hull = ConvexHull(points)
    planes = np.round(hull.equations, _PLANE_DIGITS)
    _, first, face_of_triangle = np.unique(planes, axis=0, return_index=True, return_inverse=True)
    face_of_triangle = face_of_triangle.reshape(-1)
    ends, faces = [], []
    for triangle, neighbours in enumerate(hull.neighbors):
        for corner, neighbour in enumerate(neighbours):  # the neighbour opposite of a corner
            if triangle < neighbour and face_of_triangle[triangle] != face_of_triangle[neighbour]:
                ends.append(np.delete(hull.simplices[triangle], corner))
                faces.append([face_of_triangle[triangle], face_of_triangle[neighbour]])
    kept, renumbered = np.unique(np.array(ends), return_inverse=True)
    return Part(
        vertices=points[kept],
        normals=hull.equations[first, :3],
        offsets=-hull.equations[first, 3],
        edges=renumbered.reshape(-1, 2),
        edge_faces=np.array(faces),
        opaque=opaque,
    )


def cube_rotations() -> np.ndarray:
    """Return the 24 rotations (24, 3, 3) that bring a cube onto itself, the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0:
                found.append(R)
    return np.array(sorted(found, key=lambda R: -np.trace(R)))


def _object_mesh(model: mujoco.MjModel, entry: ObjectSpec) -> ObjectMesh:
    body = model.body(entry.name).id
    bodies = _fixed_below(model, body)
    geoms = _seen(model, bodies)
    if geoms and _is_bar(model, body, geoms) and entry.symmetry != "any":
        geoms = _seen(model, _fixed_below(model, _root(model, body)))
    if not geoms:
        raise SceneError(f"an object {entry.name!r} without a visible geom", "a shape to track", "give it one")
    clouds = {geom: _points(model, body, geom) for geom in geoms}
    extent = np.ptp(np.concatenate(list(clouds.values())), axis=0)
    least = _SMALL * float(np.linalg.norm(extent))
    large = [geom for geom in geoms if np.linalg.norm(np.ptp(clouds[geom], axis=0)) >= least]
    parts = tuple(convex_part(clouds[geom], bool(model.geom_rgba[geom, 3] >= TRANSPARENT)) for geom in large)
    return ObjectMesh(
        name=entry.name,
        parts=parts,
        geoms=tuple(geoms),
        colors=np.unique(np.round(_colors(model, large), 3), axis=0),
        symmetries=_symmetries(convex_part(np.concatenate([part.vertices for part in parts])).vertices),
        spec=entry,
        fixed=bool(model.body_mocapid[_root(model, body)] >= 0),
    )


def _colors(model: mujoco.MjModel, geoms: Sequence[int]) -> np.ndarray:
    return np.array([model.geom_rgba[geom, :3] for geom in geoms], dtype=np.float64)


def _is_fixed(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body is fixed to another one that can move or be moved."""
    parent = int(model.body_parentid[body])
    return model.body_jntnum[body] == 0 and model.body_mocapid[body] < 0 and parent != 0


def _root(model: mujoco.MjModel, body: int) -> int:
    """Return the topmost body of the rigid thing that a body is part of."""
    while _is_fixed(model, body):
        body = int(model.body_parentid[body])
    return body


def _fixed_below(model: mujoco.MjModel, root: int) -> list[int]:
    """Return a body and all that is fixed to it."""
    bodies = [root]
    for body in range(root + 1, model.nbody):
        if int(model.body_parentid[body]) in bodies and model.body_jntnum[body] == 0:
            bodies.append(body)
    return bodies


def _seen(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    visible = (model.geom_group < _SEEN_GROUPS) & (model.geom_rgba[:, 3] > 0) & np.isin(model.geom_bodyid, bodies)
    return np.flatnonzero(visible).tolist()


def _is_bar(model: mujoco.MjModel, body: int, geoms: Sequence[int]) -> bool:
    """Return whether geoms make a thin bar: much longer than it is wide."""
    if not _is_fixed(model, body):
        return False
    points = np.concatenate([_points(model, body, geom) for geom in geoms])
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
    return bool(spread[1] < _THIN * spread[2])


def _points(model: mujoco.MjModel, body: int, geom: int) -> np.ndarray:
    """Return points (n, 3) [m] whose convex hull is a geom, in the frame of a body that it is fixed to."""
    T_body_geom = poses.pose(model.geom_pos[geom], model.geom_quat[geom])
    at = int(model.geom_bodyid[geom])
    root = _root(model, body)
    # The geom may hang on a body above or beside this one: both places are relative to the top of the rigid thing.
    T_root_body, T_root_at = _in_root(model, body, root), _in_root(model, at, root)
    return poses.transform(poses.invert(T_root_body) @ T_root_at @ T_body_geom, _local_points(model, geom))


def _in_root(model: mujoco.MjModel, body: int, root: int) -> np.ndarray:
    T = np.eye(4)
    while body != root:
        T = poses.pose(model.body_pos[body], model.body_quat[body]) @ T
        body = int(model.body_parentid[body])
    return T


def _local_points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    shapes = mujoco.mjtGeom
    if kind == shapes.mjGEOM_BOX:
        return np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * size
    if kind == shapes.mjGEOM_CYLINDER:
        return np.concatenate([_ring(size[0], end * size[1]) for end in (-1, 1)])
    if kind == shapes.mjGEOM_CAPSULE:
        rings = []
        for end in (-1, 1):
            for tilt in np.linspace(0.0, math.pi / 2, 4):
                rings.append(_ring(size[0] * math.cos(tilt), end * (size[1] + size[0] * math.sin(tilt)), SLICES // 2))
        return np.concatenate(rings)
    if kind in (shapes.mjGEOM_SPHERE, shapes.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == shapes.mjGEOM_SPHERE else size
        tilts = np.linspace(-math.pi / 2, math.pi / 2, 9)
        return np.concatenate([_ring(math.cos(tilt), math.sin(tilt), SLICES // 2) for tilt in tilts]) * radii
    if kind == shapes.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
        return points[ConvexHull(points).vertices]
    raise SceneError(f"a geom of type {kind} in a tracked object", "a box, round thing or mesh", "add it elsewhere")


def _ring(radius: float, height: float, count: int = SLICES) -> np.ndarray:
    angles = 2.0 * math.pi / count * np.arange(count)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)


def _symmetries(vertices: np.ndarray) -> np.ndarray:
    """Return the rotations of a cube (s, 3, 3) that bring a cloud of vertices (n, 3) onto itself."""
    kept = []
    for R in cube_rotations():
        turned = vertices @ R.T
        apart = np.linalg.norm(turned[:, None] - vertices[None], axis=-1)
        if apart.min(axis=1).max() < 1e-3:
            kept.append(R)
    return np.array(kept)
