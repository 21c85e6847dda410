"""Masks: exact, rough at their edges, by colour."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm.errors import SceneError
from gym_demohlm.perception import masks
from gym_demohlm.perception.meshes import object_meshes
from gym_demohlm.perception.perceiver import make_perceiver
from gym_demohlm.registry import get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation


def _ids() -> np.ndarray:
    ids = np.full((120, 160), -1, np.int32)
    ids[30:90, 40:120] = 7
    return ids


def test_the_exact_mask_is_that_of_the_ids() -> None:
    np.testing.assert_array_equal(masks.oracle(_ids(), [7], np.random.default_rng(0), 0.0), _ids() == 7)


def test_a_rough_mask_errs_at_its_edge_alone_and_about_as_much_as_asked() -> None:
    exact = _ids() == 7
    grown, shrunk = np.zeros_like(exact), np.zeros_like(exact)
    grown[26:94, 36:124] = True
    shrunk[34:86, 44:116] = True
    wrong = []
    for seed in range(20):
        rough = masks.oracle(_ids(), [7], np.random.default_rng(seed), 1.0)
        assert rough[shrunk].all() and not rough[~grown].any()
        wrong.append((rough != exact).sum())
    perimeter = 2 * (60 + 80)
    assert 0.3 * perimeter < np.mean(wrong) < 1.2 * perimeter  # E|N(0, 1 px)| is 0.8 px


def test_an_object_that_is_not_seen_has_an_empty_mask() -> None:
    assert not masks.oracle(_ids(), [3], np.random.default_rng(0), 1.0).any()


def test_colour_finds_a_thing_in_shadow_and_in_light_but_no_grey_one() -> None:
    image = np.full((60, 90, 3), 128, np.uint8)
    image[10:50, 10:40] = 200, 60, 50
    image[10:50, 50:80] = 100, 30, 25
    found = masks.color(image, np.array([[0.8, 0.25, 0.2]]))
    assert found[12:48, 12:38].all() and found[12:48, 52:78].all() and not found[:8].any()
    near = masks.component_near(found, (65.0, 30.0), 40)
    assert near[30, 65] and not near[30, 25]


@pytest.mark.parametrize(("task", "named"), [("EraseBoard", "eraser, board"), ("PourWater", "bowl")])
def test_grey_objects_are_refused_as_colour_does_not_tell_them_from_walls(task: str, named: str) -> None:
    sim = Simulation(get_task(task), 1)
    sim.reset([get_task(task).sample("R1", np.random.default_rng(0))])
    eyes = make_perceiver("rgbd,masks=color", get_task(task), 1)
    with pytest.raises(SceneError, match=f"parts of {named} that are white.*masks=oracle"):
        eyes.observe(sim, np.arange(1))
    sim.close()


def test_black_is_grey() -> None:
    (mesh,) = object_meshes(build_scene(get_task("PressCube")).model, get_task("PressCube"))
    assert masks.grey([mesh]) == []
    for colour in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.05)):  # darker than any pixel that `color` takes
        assert masks.grey([replace(mesh, colors=np.array([[0.8, 0.2, 0.2], colour]))]) == ["cube"]
