"""An operator's recording: where the robot cannot get to, and what is said."""

import dataclasses
import socket
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.teleop import recorder
from lerobot_demohlm.teleop.record import record, script_of
from lerobot_demohlm.teleop.session import RecordingSession, SessionSettings
from lerobot_demohlm.teleop.web import record as web_record
from lerobot_demohlm.teleop.web.record import WebSettings, operators_place, record_in_browser


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


def test_the_length_that_is_told_is_that_of_what_was_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Server:
        def __init__(self, session: RecordingSession, *_: Any) -> None:
            self.session = session

        def run(self) -> None:
            operator = script_of(self.session.task).make_operator()
            first = operator.poses(self.session.view())
            assert first is not None
            self.session.press("record")
            for _ in range(15):  # idle, and cut off
                self.session.carry_out(first)
            while (asked := operator.poses(self.session.view())) is not None:
                self.session.carry_out(asked)
            self.session.press("record")
            self.session.press("save")

    monkeypatch.setattr(web_record, "TeleopServer", Server)
    task, root = get_task("LiftBox"), tmp_path / "lift"
    length = record_in_browser(task, root, WebSettings(port=0, session=SessionSettings(trial=None)))
    saved = demonstrations.load(root, task)
    assert length == len(saved) and saved.metadata["cut"][0] > 5


def test_a_busy_port_is_told_before_the_robot_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_record, "RecordingSession", None)
    with socket.create_server(("127.0.0.1", 0)) as busy:
        settings = WebSettings(host="127.0.0.1", port=busy.getsockname()[1])
        with pytest.raises(DemonstrationError, match=r"address already in use.*--port"):
            record_in_browser(get_task("LiftBox"), tmp_path / "lift", settings)
