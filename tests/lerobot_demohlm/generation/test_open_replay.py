"""The open replay looks at nothing once a part of the motion has begun; ours does."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik_settings import IKSettings
from gym_demohlm.registry import get_task
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.generation.locomotion import walk
from lerobot_demohlm.generation.open_replay import open_replay, without_symmetry
from lerobot_demohlm.generation.stages import Settings


def test_it_keeps_the_variation_and_changes_every_loop() -> None:
    ours = Settings(variation=replace(PLAIN, variation="real"))
    found = open_replay(ours)
    assert found.variation == ours.variation and found.retreat == ours.retreat
    for name in ("locomotion", "adaptation", "grip", "playback"):
        assert getattr(found, name) != getattr(ours, name)
    assert found.playback.transit_speed == ours.playback.transit_speed
    assert found.walking.max_walks == 1
    assert (found.gripping.grip_n, found.retries, found.ik) == (0.0, 0, IKSettings())


def test_one_walk_must_do() -> None:
    """A robot that stumbles aside as it stops walks again in ours, and not in an open replay."""
    ours = Settings(variation=PLAIN)
    for settings, walks in ((ours, 2), (open_replay(ours), 1)):
        base, stops, standing = np.array([-0.6, 0.0, 0.0]), 0, False
        for wanted in walk(lambda: poses.planar(*base), np.zeros(3), settings.walking):  # noqa: B023
            velocity = wanted[command.VELOCITY]
            if not velocity.any() and not standing:
                stops += 1
                base = base + np.array([0.0, 0.15 if stops == 1 else 0.0, 0.0])
            standing = not velocity.any()
            base = poses.to_planar(poses.planar(*base) @ poses.planar(*(0.1 * velocity)))
        assert stops >= walks if walks > 1 else stops == 1


@pytest.mark.parametrize("name", ["LiftBox", "GraspCube", "PushCube"])
def test_without_symmetry_objects_turn_away(name: str) -> None:
    task = get_task(name)
    bare = without_symmetry(task)
    assert all(entry.symmetry == (0.0,) for entry in bare.objects)
    assert not task.turns_away("R3") and bare.turns_away("R3") and not bare.turns_away("R1")
    assert [entry.position for entry in bare.objects] == [entry.position for entry in task.objects]
