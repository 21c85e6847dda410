"""Tags on drawn objects: where they are, how near their poses come, and that only what is drawn wears them."""

import cv2
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.perception import camera
from gym_demohlm.perception.meshes import object_meshes
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.tag_layout import is_tag, layout, tagged_model
from gym_demohlm.perception.tags import TagFinder, object_pose
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_every_object_wears_tags_and_no_two_are_the_same(name: str) -> None:
    task = get_task(name)
    scene = build_scene(task)
    model = scene.model
    tagged, tags = tagged_model(scene)
    ids = [tag.id for worn in tags for tag in worn]
    assert len(set(ids)) == len(ids) and all(worn for worn in tags)
    assert (tagged.nq, tagged.nbody, tagged.nmocap) == (model.nq, model.nbody, model.nmocap)
    assert tagged.body_mass.sum() == pytest.approx(model.body_mass.sum())
    new = np.flatnonzero(is_tag(tagged))
    np.testing.assert_array_equal(np.delete(tagged.geom_size, new, axis=0), model.geom_size)
    assert len(new) == len(ids) and not tagged.geom_contype[new].any() and not tagged.geom_conaffinity[new].any()


def test_tags_of_a_box_are_as_large_as_its_faces_allow() -> None:
    task = get_task("LiftBox")
    (worn,) = layout(object_meshes(build_scene(task).model, task))
    assert [round(tag.edge, 3) for tag in worn] == [0.08] * 6
    out = np.array([tag.T_object_tag[:3, 2] @ tag.T_object_tag[:3, 3] for tag in worn])
    np.testing.assert_allclose(np.sort(out), [0.091, 0.091, 0.131, 0.131, 0.131, 0.131], atol=1e-6)  # faces, plates


def test_corners_of_a_pure_picture_give_the_pose() -> None:
    """A tag drawn by a homography, without a renderer."""
    task = get_task("LiftBox")
    (worn,) = layout(object_meshes(build_scene(task).model, task))
    known, tag = camera.head_intrinsics(), worn[0]
    T_optical_tag = poses.from_rotation(
        poses.rotation_from_vector([2.6, 0.3, 0.2]), [0.03, -0.02, 0.6]
    )  # its z axis looks at the lens
    T = T_optical_tag @ poses.invert(tag.T_object_tag)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = cv2.aruco.generateImageMarker(dictionary, tag.id, 400)
    black = cv2.rotate(black, cv2.ROTATE_180)  # OpenCV draws tags of this family upside down
    image = cv2.copyMakeBorder(black, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)
    half = 0.5 * tag.edge * 500 / 400
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    uv = known.project(poses.transform(T_optical_tag, square))
    scale = 4
    H = cv2.getPerspectiveTransform(
        np.array([[0, 0], [500, 0], [500, 500], [0, 500]], np.float32) - 0.5,
        ((uv + 0.5) * scale - 0.5).astype(np.float32),
    )
    large = np.full((480 * scale, 640 * scale), 120, np.uint8)
    cv2.warpPerspective(image, H, (640 * scale, 480 * scale), large, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    grey = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)
    found = object_pose(worn, TagFinder().corners(grey, camera.whole(known)), known, T)
    assert found is not None
    assert np.linalg.norm(found[0][:3, 3] - T[:3, 3]) < 0.003
    assert np.linalg.norm(poses.rotation_vector(found[0][:3, :3].T @ T[:3, :3])) < np.radians(1.5)


def test_a_box_with_tags_is_told_where_it_is_and_lost_when_its_tags_are_out_of_sight() -> None:
    task = get_task("LiftBox")
    sim = Simulation(task, 1)
    sim.reset([{"robot": [-0.35, 0.0, 0.0], "object": [0.0, 0.0, 0.2]}])
    perceiver, exact = make_perceiver("apriltag", task, 1), make_perceiver("exact", task, 1)
    row = np.array([0])
    off = []
    for _ in range(5):
        sim.step(sim.command)
        seen, true = perceiver.observe(sim, row), exact.observe(sim, row)
        assert seen.valid.all()
        off.append(1e3 * np.linalg.norm((seen.T_camera_object - true.T_camera_object)[0, 0, :3, 3]))
    assert np.median(off) < 4.0
    before = seen.T_camera_object[0, 0]
    sim.set_pose("box", poses.pose([-3.0, 0.0, 1.0]))
    later = sim.snapshot()
    later["physics"][:, 0] += 0.1  # s: the world's time goes on, nothing moves
    sim.restore(later)
    gone = perceiver.observe(sim, row)
    assert not gone.valid.any() and gone.age_s[0, 0] == pytest.approx(0.1)
    assert np.linalg.norm(gone.T_camera_object[0, 0, :3, 3] - before[:3, 3]) < 0.02
    perceiver.close()
    sim.close()
