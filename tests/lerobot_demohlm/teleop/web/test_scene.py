"""What a headset is given to draw: light enough, and still the thing itself."""

import json

import mujoco
import numpy as np
import pytest

from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from lerobot_demohlm.teleop.web import scene

MAX_TRIANGLES = 70_000
MAX_COARSE = 0.6  # share of them


@pytest.mark.parametrize("name", ["EraseBoard", "LiftBox", "PushCart"])
def test_every_task_is_light_and_whole(name: str) -> None:
    task = get_task(name)
    package = scene.package(build_scene(task).model, task)
    described = json.loads(package.description)
    vertices = np.frombuffer(package.buffers, "<f4", described["vertices"] * 6).reshape(-1, 6)
    indices = np.frombuffer(package.buffers, "<u4", offset=vertices.nbytes)
    parts = described["geoms"] + [entry["coarse"] for entry in described["geoms"] if "coarse" in entry]
    assert len(indices) == described["indices"] == sum(part["count"] for part in parts)
    assert sum(entry["count"] for entry in described["geoms"]) == 3 * package.num_triangles
    assert sum(entry.get("coarse", entry)["count"] for entry in described["geoms"]) == 3 * package.num_coarse
    assert package.num_triangles < MAX_TRIANGLES
    assert package.num_coarse < MAX_COARSE * package.num_triangles
    assert indices.max() < len(vertices)
    np.testing.assert_allclose(np.linalg.norm(vertices[:, 3:], axis=1), 1.0, atol=1e-3)
    drawn = {entry["body"] for entry in described["geoms"]}
    named = {
        body for body, name in enumerate(described["bodies"]) if name in ("torso_link", "left_elbow_link", "pelvis")
    }
    assert named <= drawn
    assert max(part["first"] + part["count"] for part in parts) == described["indices"]


@pytest.mark.parametrize(("cells", "near"), [(scene.CELLS, 0.06), (scene.COARSE_CELLS, 0.2)])
def test_clustered_meshes_stay_where_they_are(cells: int, near: float) -> None:
    model = build_scene(get_task("LiftBox")).model
    for geom in np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group < 3)):
        points, _, faces = scene.triangles(model, int(geom), cells)
        first = model.mesh_vertadr[model.geom_dataid[geom]]
        full = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]]
        size = np.ptp(full, axis=0).max()
        used = points[np.unique(faces)]
        assert np.abs(used.min(axis=0) - full.min(axis=0)).max() < near * size
        assert np.abs(used.max(axis=0) - full.max(axis=0)).max() < near * size


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder", "capsule", "ellipsoid"])
def test_primitives_face_outwards_and_have_their_volume(kind: str) -> None:
    size = {"box": [0.1, 0.2, 0.3], "sphere": [0.2, 0, 0], "cylinder": [0.1, 0.3, 0], "capsule": [0.1, 0.3, 0]}.get(
        kind, [0.1, 0.2, 0.3]
    )
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    points, normals, faces = scene.triangles(spec.compile(), 0)
    corners = points[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    expected = {
        "box": 8 * 0.1 * 0.2 * 0.3,
        "sphere": 4 / 3 * np.pi * 0.2**3,
        "cylinder": np.pi * 0.01 * 0.6,
        "capsule": np.pi * 0.01 * 0.6 + 4 / 3 * np.pi * 0.001,
        "ellipsoid": 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
    }[kind]
    assert volume == pytest.approx(expected, rel=0.06)
    assert ((points * normals).sum(axis=1) > -1e-9).all()
