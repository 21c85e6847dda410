"""Tracked objects -> AprilTags on their faces: which, where and how large; and the drawn scene that wears them.

The tags are of the family 36h11, and on the drawn copy of the scene only: nothing that is simulated knows of them.
An object's largest flat faces wear one each, or four plates around it where all faces are small, as a bar's are.
So does a round thing, such as a bottle.
"""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.meshes import ObjectMesh, Part, known_meshes
from gym_demohlm.scene import Scene, scene_spec

FAMILY = "tag36h11"
CELLS = 10  # of a tag with its white border, 8 of them within the black one
LARGEST = 0.10  # m, edge of a plate: its tag's black edge is 8 cm
_FACES = 6  # tags an object
_PLATE = 0.06  # m, edge of plates around a round thing or on a bar
_SMALL = 0.045  # m: an object without a larger face wears such plates
_LEAST = 0.01  # m: smaller faces wear nothing
_THICKNESS = 0.0005  # m, of half a plate
_PIXELS = 40  # of a texture, for each cell


@dataclass(frozen=True, kw_only=True)
class Tag:
    """One tag on an object.

    Attributes:
        id: In the family.
        T_object_tag: (4, 4) its middle, z out of the face, y up in the picture on it.
        edge: Of its black square [m].
    """

    id: int
    T_object_tag: np.ndarray
    edge: float

    @property
    def plate(self) -> str:
        """Name of its geom in the drawn scene."""
        return f"tag_{self.id}"

    @property
    def corners(self) -> np.ndarray:
        """(4, 3) corners of the black square in the object's frame [m], counter-clockwise from the lower left."""
        half = 0.5 * self.edge
        return poses.transform(
            self.T_object_tag, np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
        )


def layout(meshes: tuple[ObjectMesh, ...]) -> tuple[tuple[Tag, ...], ...]:
    """Return the tags of each object, every id once."""
    found: list[tuple[Tag, ...]] = []
    first = 0
    for mesh in meshes:
        plates = _around(mesh.vertices) if mesh.spec.symmetry == "any" else _on_faces(mesh)
        tags = tuple(
            Tag(id=first + index, T_object_tag=T, edge=edge * (CELLS - 2) / CELLS)
            for index, (T, edge) in enumerate(plates)
        )
        first += len(tags)
        found.append(tags)
    return tuple(found)


def tagged_model(scene: Scene) -> tuple[mujoco.MjModel, tuple[tuple[Tag, ...], ...]]:
    """Return a compiled scene whose objects wear tags, and the tags of each object.

    Args:
        scene: The scene; the one with tags has the same joints and bodies.
    """
    task, tags = scene.task, layout(known_meshes(scene))
    spec = scene_spec(task, scene.robot_physics, scene.variation)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for entry, worn in zip(task.objects, tags, strict=True):
        body = spec.body(entry.name)
        for tag in worn:
            _add_material(spec, tag.plate, cv2.aruco.generateImageMarker(dictionary, tag.id, 8 * _PIXELS, borderBits=1))
            half = 0.5 * tag.edge * CELLS / (CELLS - 2)
            position, quat = poses.split(tag.T_object_tag @ poses.pose([0.0, 0.0, -_THICKNESS]))
            body.add_geom(
                name=tag.plate,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[half, half, _THICKNESS],
                pos=position,
                quat=quat,
                material=tag.plate,
                contype=0,
                conaffinity=0,
                mass=0.0,
                group=2,
            )
    return spec.compile(), tags


def is_tag(model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms (ngeom,) of a scene with tags are tags; the others are those of the plain scene, in order."""
    return np.array([model.geom(geom).name.startswith("tag_") for geom in range(model.ngeom)])


def _add_material(spec: mujoco.MjSpec, name: str, black: np.ndarray) -> None:
    """Add a material that shows a tag with a white border."""
    image = cv2.copyMakeBorder(black, _PIXELS, _PIXELS, _PIXELS, _PIXELS, cv2.BORDER_CONSTANT, value=255)
    size = len(image)
    # OpenCV draws tags of this family upside down.
    pixels = np.repeat(np.ascontiguousarray(image[::-1, ::-1, None]), 3, axis=2)
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=size, height=size, nchannel=3)
    texture.data = pixels.tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _faces(part: Part) -> list[tuple[np.ndarray, float]]:
    """Return the places (4, 4) and edges [m] of square plates on the faces of a part that are large enough."""
    found = []
    for face, (normal, offset) in enumerate(zip(part.normals, part.offsets, strict=True)):
        on = np.abs(part.vertices @ normal - offset) < 1e-4
        corners = part.vertices[on]
        if len(corners) < 3:
            continue
        middle = corners.mean(axis=0)
        sides = zip(part.edges, part.edge_faces, strict=True)
        ends = next(part.vertices[side] for side, faces in sides if face in faces)
        x = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        up = np.cross(normal, x)
        if abs(x[2]) > abs(up[2]):  # the tag stands upright where its face does
            x, up = -up, x
        if up[2] < 0:
            x, up = -x, -up
        others = np.delete(np.arange(len(part.normals)), face)
        room = part.offsets[others] - part.normals[others] @ middle
        reach = np.abs(part.normals[others] @ x) + np.abs(part.normals[others] @ up)
        edge = 2.0 * float((room[reach > 1e-6] / reach[reach > 1e-6]).min(initial=LARGEST / 2.0))
        if edge >= _LEAST:
            R = np.stack([x, up, normal], axis=1)
            found.append((poses.from_rotation(R, middle + 2.0 * _THICKNESS * normal), edge))
    return found


def _on_faces(mesh: ObjectMesh) -> list[tuple[np.ndarray, float]]:
    """Return the places (4, 4) and edges [m] of plates on the largest faces of an object."""
    places = sorted((place for part in mesh.parts for place in _faces(part)), key=lambda place: -place[1])[:_FACES]
    if places[0][1] < _SMALL:
        inside = (part for part in mesh.parts if (part.offsets > 0).all())  # around the object's own middle
        return _around(next(inside, mesh.parts[0]).vertices)
    return [(T, edge) for T, edge in places if edge >= 0.03]


def _around(vertices: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Return the places (4, 4) and edges [m] of four plates that touch a cloud of vertices (n, 3) from its sides."""
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    found = []
    for turn in range(4):
        R = poses.planar(0.0, 0.0, 0.5 * np.pi * turn)[:3, :3] @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        reach = float(((vertices - middle) @ R[:, 2]).max())
        found.append((poses.from_rotation(R, middle + reach * R[:, 2]), _PLATE))
    return found
