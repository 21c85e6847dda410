"""Hands at the sides of a box move with the sides of a box of another size."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, load
from lerobot_demohlm.generation.fitting import fitted


def test_a_demonstration_of_the_same_things_stays() -> None:
    for name in ("LiftBox", "GraspCube"):
        task = get_task(name)
        source = load(None, task)
        assert fitted(source, task) is source
    assert fitted(source, task.at("R4")) is source  # a mark changes no side


@pytest.mark.parametrize("name", ["LiftBox", "CarryBox"])
def test_palms_keep_their_distance_from_the_sides(name: str) -> None:
    task = get_task(name).at("R4")
    source = load(None, task)
    made = fitted(source, task)
    assert task.objects[0].resized is not None
    then, now = task.objects[0].resized
    held = (source.contact_forces >= CONTACT_FORCE_N).all(axis=1)
    T_box_world = poses.invert(source.T_world_objects[held][:, None, 0])
    before, after = (T_box_world @ demonstration.T_world_targets[held] for demonstration in (source, made))
    across = np.argmax(np.abs(before[0, 0, :2, 3]))  # the axis that the palms press along
    apart = [np.abs(T[..., across, 3]) - lengths[across] / 2 for T, lengths in ((before, then), (after, now))]
    np.testing.assert_allclose(apart[1], apart[0], atol=1e-9)
    np.testing.assert_allclose(after[..., 2, 3], before[..., 2, 3], atol=1e-9)
    np.testing.assert_array_equal(after[..., :3, :3], before[..., :3, :3])
    np.testing.assert_array_equal(made.object_poses, source.object_poses)


def test_hands_move_no_further_than_the_sides() -> None:
    task = get_task("LiftBox").at("R4")
    source = load(None, task)
    made = fitted(source, task)
    assert task.objects[0].resized is not None
    then, now = (np.array(lengths) for lengths in task.objects[0].resized)
    moved = np.linalg.norm(made.hand_poses[..., :3] - source.hand_poses[..., :3], axis=-1)
    assert 0.0 < moved.max() <= np.linalg.norm(now - then) / 2 + 1e-12
