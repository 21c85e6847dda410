"""Colour and depth in one pass: the pixels of two passes, nearer than the sky, and of what lets light through.

What a window leaves out changes none of its pixels.
"""

from collections.abc import Iterator

import numpy as np
import pytest

from gym_demohlm.perception.camera import Window, head_intrinsics
from gym_demohlm.perception.meshes import ObjectMesh, object_meshes
from gym_demohlm.perception.visual_model import VisualModel
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene

SKY = 10.0  # m: things are nearer


@pytest.fixture(params=["LiftBox", "GraspCube"])
def seen(request: pytest.FixtureRequest) -> Iterator[tuple[VisualModel, ObjectMesh]]:
    task = get_task(request.param)
    scene = build_scene(task)
    (mesh,) = object_meshes(scene.model, task)
    qpos, mocap_pos, mocap_quat = scene.place({"robot": [-0.35, 0, 0], "object": [0, 0, 0.3]})
    qpos[scene.neck_qpos] = 0.0, 0.6
    made = VisualModel(scene.model, head_intrinsics(96, 96))
    made.place(qpos, mocap_pos, mocap_quat)
    yield made, mesh
    made.close()


def test_one_pass_gives_the_pixels_of_two(seen: tuple[VisualModel, ObjectMesh]) -> None:
    visual, _ = seen
    rgb, depth = visual.rgb_and_depth()
    expected = visual.depth_and_ids().depth
    np.testing.assert_array_equal(rgb, visual.rgb())
    np.testing.assert_array_equal(np.minimum(depth, SKY), np.minimum(expected, SKY))
    assert (expected < 3.0).sum() > 1000


def test_a_transparent_thing_keeps_its_depth(seen: tuple[VisualModel, ObjectMesh]) -> None:
    """A pass of colours leaves it out in part, so it takes two."""
    visual, mesh = seen
    geoms = np.array(mesh.geoms)
    visual.model.geom_rgba[geoms, 3] = 0.5
    frame = visual.depth_and_ids()
    assert np.isin(frame.ids, geoms).any()
    np.testing.assert_array_equal(visual.rgb_and_depth()[1], frame.depth)


@pytest.mark.parametrize("window", [None, Window(left=30, top=40, width=41, height=23)])
@pytest.mark.parametrize("pitch", [0.0, 0.6, 1.0])
def test_what_is_left_out_changes_no_pixel(
    seen: tuple[VisualModel, ObjectMesh], pitch: float, window: Window | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    visual, _ = seen
    qpos = visual.data.qpos.copy()
    qpos[visual.model.joint("neck_pitch_joint").qposadr] = pitch
    visual.place(qpos, visual.data.mocap_pos.copy(), visual.data.mocap_quat.copy())
    found = visual.depth_and_ids(window)
    left_out = visual._outside(found.window)
    assert left_out[visual.drawn].any()
    monkeypatch.setattr(visual, "_outside", lambda window: np.zeros_like(left_out))
    expected = visual.depth_and_ids(window)
    np.testing.assert_array_equal(found.ids, expected.ids)
    np.testing.assert_array_equal(found.depth, expected.depth)
    assert not left_out[np.unique(found.ids[found.ids >= 0])].any()
