"""An operator's recording: where the robot cannot get to, and what is said."""

import dataclasses

import pytest

from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from lerobot_demohlm.teleop import recorder
from lerobot_demohlm.teleop.record import record, script_of


def test_a_robot_that_does_not_get_to_the_operators_place_is_told_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "EXACT", dataclasses.replace(recorder.EXACT, max_ticks=5))
    task = get_task("LiftBox")
    with pytest.raises(DemonstrationError, match="from the operator's place"):
        record(task, script_of(task).make_operator())
