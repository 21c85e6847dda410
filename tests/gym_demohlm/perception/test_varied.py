"""Worlds that differ from the plain one are drawn as they are, by everything that draws them."""

import itertools
from contextlib import closing

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control.controllers import DEFAULT
from gym_demohlm.perception.apriltag import AprilTagPerceiver
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.perception.seeing import SeeingPerceiver
from gym_demohlm.perception.small_pictures import SmallPictures
from gym_demohlm.perception.tag_layout import tagged_model
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState
from gym_demohlm.tasks.lift_box import BOX_SIZE
from gym_demohlm.variation import get_variation

SIZES = (1.0, 1.3, 0.8)
ROWS = np.arange(len(SIZES))


@pytest.fixture(scope="module", params=[DEFAULT, "8ac4c8cd0008"])  # robots of both physics, with other geoms
def sim(request: pytest.FixtureRequest) -> Simulation:
    """Worlds with boxes of other sizes, which the robot sees from a metre."""
    varied = get_variation("hard:objects+scene")
    made = Simulation(get_task("LiftBox"), len(SIZES), controller=request.param, variation=varied)
    plain: InitialState = {"robot": [-0.35, 0.0, 0.0], "object": [0.0, 0.0, 0.2]}
    made.reset([plain if size == 1.0 else plain | {"objects.size.box": [size]} for size in SIZES])
    return made


def _true_extent(perceiver: SeeingPerceiver, sim: Simulation, row: int) -> np.ndarray:
    """Return the first and last column and row of a box of its world's size, (4,) [px]."""
    visual = perceiver._opened(sim)
    corners = SIZES[row] * np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * BOX_SIZE
    uv = visual.intrinsics.project(poses.transform(poses.invert(visual.camera_pose()) @ sim.pose("box")[row], corners))
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)])


@pytest.mark.parametrize("source", ["rgbd", "remote,timeout_s=0.01", "apriltag"])
def test_a_varied_box_has_its_varied_size_in_the_picture(source: str, sim: Simulation) -> None:
    perceiver = make_perceiver(source, sim.task, len(SIZES))
    assert isinstance(perceiver, SeeingPerceiver)
    areas = []
    for row in (1, 0, 2, 0):
        perceiver.observe(sim, np.array([row]))
        visual = perceiver._opened(sim)
        ids, body = visual.depth_and_ids().ids, visual.model.body("box").id
        rows, columns = np.nonzero((ids >= 0) & (visual.model.geom_bodyid[ids] == body))
        found = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
        assert np.abs(found - _true_extent(perceiver, sim, row)).max() < 4.0
        areas.append(len(rows))
    assert areas[1] == areas[3] and areas[0] > 1.4 * areas[1] > 1.4 * 1.2 * areas[2]
    perceiver.close()


def test_tags_stick_on_the_faces_of_a_varied_box(sim: Simulation) -> None:
    perceiver, exact = make_perceiver("apriltag", sim.task, len(SIZES)), make_perceiver("exact", sim.task, len(SIZES))
    seen, true = perceiver.observe(sim, ROWS), exact.observe(sim, ROWS)
    assert seen.valid.all()
    off = np.linalg.norm((seen.T_camera_object - true.T_camera_object)[:, 0, :3, 3], axis=1)
    assert off.max() < 0.01
    perceiver.close()


def test_tags_follow_the_faces_of_what_can_be_of_another_size() -> None:
    """A bottle with water in it keeps its size, a bowl does not; a plate's front is where its tag is known to be."""
    task = get_task("PourWater")
    with closing(Simulation(task, variation=get_variation("hard:objects"))) as sim:
        sim.reset([task.default_state() | {"objects.size.bottle": [1.15], "objects.size.bowl": [1.15]}])
        _, printed = tagged_model(sim.scene)
        with closing(make_perceiver("apriltag", task, 1)) as perceiver:
            assert isinstance(perceiver, AprilTagPerceiver)
            perceiver.observe(sim, np.array([0]))
            model = perceiver._opened(sim).model
            for size, plain, known in zip((1.0, 1.15), printed, perceiver._tags, strict=True):
                for before, tag in zip(plain, known, strict=True):
                    place = tag.T_object_tag[:3, 3]
                    np.testing.assert_allclose(place, size * before.T_object_tag[:3, 3], atol=1e-12)
                    plate = model.geom(tag.plate)
                    front = plate.pos + plate.size[2] * tag.T_object_tag[:3, 2]
                    np.testing.assert_allclose(front, place, atol=1e-9)


def test_small_pictures_show_the_varied_box(sim: Simulation) -> None:
    pictures = SmallPictures(sim, (96, 96))
    plain, large, small = (pictures.rgb(row).astype(int) for row in ROWS)
    assert np.abs(plain - large).max(axis=-1).astype(bool).sum() > 50
    assert np.abs(plain - small).max(axis=-1).astype(bool).sum() > 50
    np.testing.assert_array_equal(pictures.rgb(0), plain)
    pictures.close()
