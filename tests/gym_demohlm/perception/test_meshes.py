"""Tracked objects as convex parts, in every task."""

import numpy as np
import pytest

from gym_demohlm.perception.meshes import convex_part, cube_rotations, object_meshes
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.scene import build_scene


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_every_tracked_object_has_convex_parts_with_outward_faces(name: str) -> None:
    task = get_task(name)
    for mesh in object_meshes(build_scene(task).model, task):
        assert mesh.parts and mesh.geoms
        np.testing.assert_array_equal(mesh.symmetries[0], np.eye(3))
        for part in mesh.parts:
            distances = part.vertices @ part.normals.T - part.offsets
            assert distances.max() < 1e-6  # convex: no vertex outside a face
            assert len(part.vertices) - len(part.edges) + len(part.normals) == 2  # Euler: closed


def test_sizes_and_symmetries_are_those_of_the_task() -> None:
    (box,) = object_meshes(build_scene(get_task("LiftBox")).model, get_task("LiftBox"))
    np.testing.assert_allclose(np.ptp(box.vertices, axis=0), (0.26, 0.26, 0.18))
    assert len(box.symmetries) == 8 and not box.fixed
    (cube,) = object_meshes(build_scene(get_task("GraspCube")).model, get_task("GraspCube"))
    assert len(cube.symmetries) == 24
    np.testing.assert_allclose(np.ptp(cube.scaled(1.02).vertices, axis=0), 1.02 * 0.06)


def test_a_thin_bar_is_tracked_by_what_it_is_fixed_to() -> None:
    handle, cabinet = object_meshes(build_scene(get_task("OpenCabinet")).model, get_task("OpenCabinet"))
    assert np.ptp(handle.vertices, axis=0)[2] > 0.6  # the door's height, not the handle's 0.2 m
    assert cabinet.fixed and not handle.fixed


def test_glass_is_transparent() -> None:
    bottle, bowl = object_meshes(build_scene(get_task("PourWater")).model, get_task("PourWater"))
    assert not any(part.opaque for part in bottle.parts) and all(part.opaque for part in bowl.parts)


def test_flat_faces_are_merged_and_rotations_of_a_cube_are_a_group() -> None:
    cube = convex_part(np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float))
    assert len(cube.normals) == 6 and len(cube.edges) == 12
    rotations = cube_rotations()
    assert len(rotations) == 24
    for R in rotations:
        assert min(np.abs(rotations[5] @ R - other).max() for other in rotations) < 1e-12
