"""An operator's recording: where the robot cannot get to, and what is said."""

import dataclasses

import pytest

from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from lerobot_demohlm.teleop import recorder
from lerobot_demohlm.teleop.record import record, script_of
from lerobot_demohlm.teleop.web.record import operators_place


def test_a_robot_that_does_not_get_to_the_operators_place_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "EXACT", dataclasses.replace(recorder.EXACT, max_ticks=5))
    task = get_task("LiftBox")
    with pytest.raises(DemonstrationError, match="from the operator's place"):
        record(task, script_of(task).make_operator())


def test_each_object_is_moved_by_its_own_offsets() -> None:
    task = get_task("StackCube")
    first, second = (operators_place(task, seed, "R3") for seed in (0, 1))
    moved = {name for name in first if first[name] != second[name]}
    assert moved - {"object"} and moved <= {"object", "red", "blue"}, "the robot stays at the operator's place"
    half, whole = (operators_place(task, 1, "R3", spread) for spread in (0.5, 1.0))
    assert all(half[name] == [0.5 * value for value in whole[name]] for name in whole if name != "robot")
