"""A recording session: states, going back bit for bit, the verdict before saving, a process that was killed."""

import errno
import io
import json
import os
import shutil
import time
from collections.abc import Buffer, Iterator
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import HOLD_STEPS
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.replay import replay
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.teleop.clutch import Controls, HandControls
from lerobot_demohlm.teleop.journal import Journal
from lerobot_demohlm.teleop.operator import OperatorPoses
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.review import last_held
from lerobot_demohlm.teleop.session import REWIND_TICKS, RecordingSession, SessionError, SessionSettings
from lerobot_demohlm.teleop.trial import Trial, TrialReport, TrialSettings

TASK = get_task("LiftBox")
ENGAGED = Controls(right=HandControls(pose=np.eye(4), engaged=True))


def make_session(root: Path, trial: TrialSettings | None = None) -> RecordingSession:
    settings = SessionSettings(operator="scripted", trial=trial)
    return RecordingSession(TASK, root, script_of(TASK).start, settings=settings)


def script(session: RecordingSession, skip: int = 0) -> Iterator[OperatorPoses]:
    """Yield what the scripted operator asks for as long as it sees the world of the session."""
    operator = script_of(TASK).make_operator()
    while (asked := operator.poses(session.recorder.view())) is not None:
        yield asked


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """A recording that goes back once, is killed, taken up and saved; with what was seen on the way."""
    root = tmp_path_factory.mktemp("session") / "lift"
    session = make_session(root)
    seen: dict[str, object] = {"idle": session.status()}
    session.advance(ENGAGED)
    seen["engaged"] = session.status()
    session.advance(Controls())
    session.press("discard")
    session.press("record")
    asked_for = []
    straight = []
    for asked in script(session):
        asked_for.append(asked)
        session.carry_out(asked)
        straight.append(session.sim.snapshot()["physics"].tobytes())
    seen["live"] = session.status()
    session.press("rewind")
    seen["rewound"] = session.status()
    session.advance(ENGAGED)
    seen["still held"] = session.status()
    session.advance(Controls())
    seen["waiting"] = session.status()
    again = []
    for asked in asked_for[-REWIND_TICKS:]:
        session._waiting = False
        session.carry_out(asked)
        again.append(session.sim.snapshot()["physics"].tobytes())
    seen["straight"], seen["again"] = straight[-REWIND_TICKS:], again
    rows = [row["state"].tobytes() for row in session.recorder.rows]
    session.journal._file.write(b"half a row")  # type: ignore[union-attr]
    session.close()  # as a killed process leaves it: the journal stays

    session = make_session(root)
    seen["found"] = session.status()
    session.press("recover")
    seen["same rows"] = rows == [row["state"].tobytes() for row in session.recorder.rows]
    seen["review"] = session.status()
    session.press("save")
    seen["saved"] = session.status()
    session.close()
    seen["root"] = root
    return seen


def test_states(recorded: dict[str, object]) -> None:
    states = {name: recorded[name].state for name in ("idle", "engaged", "live", "waiting", "review", "saved")}  # type: ignore[attr-defined]
    expected = ["idle", "engaged", "recording", "recording", "review", "saved"]
    assert list(states.values()) == expected


def test_what_is_seen_while_it_is_recorded(recorded: dict[str, object]) -> None:
    live = recorded["live"]
    assert live.success and live.held_s >= 1.0  # type: ignore[attr-defined]
    touches = [(hand, name) for _, hand, kind, name in live.contacts if kind == "touch"]  # type: ignore[attr-defined]
    assert {("left", "box"), ("right", "box")} <= set(touches)
    assert set(live.forces) == {"left box", "right box"} and min(live.forces.values()) > 1.0  # type: ignore[attr-defined]
    assert {kind for _, kind, _, _, _ in live.segments} == {"object", "proprioception"}  # type: ignore[attr-defined]


def test_going_back_is_exact_and_waits(recorded: dict[str, object]) -> None:
    live, rewound, held, waiting = (recorded[name] for name in ("live", "rewound", "still held", "waiting"))
    assert rewound.tick == held.tick == waiting.tick == live.tick - REWIND_TICKS  # type: ignore[attr-defined]
    assert held.paused and waiting.paused  # type: ignore[attr-defined]
    assert recorded["again"] == recorded["straight"]


def test_a_killed_recording_is_offered_again_whole(recorded: dict[str, object]) -> None:
    assert recorded["found"].unfinished == recorded["live"].tick  # type: ignore[attr-defined]
    assert recorded["same rows"]


def test_the_result_is_an_ordinary_demonstration(recorded: dict[str, object]) -> None:
    root = recorded["root"]
    assert isinstance(root, Path)
    saved = demonstrations.load(root, TASK)
    assert replay(saved).identical
    assert saved.metadata["operator"] == "scripted"
    assert {entry.kind for entry in segment(saved, TASK)} == {"object", "proprioception"}
    assert not root.with_name("lift.unfinished").exists()


@pytest.mark.slow
def test_a_trial_judges_before_it_is_saved(tmp_path: Path) -> None:
    session = make_session(tmp_path / "lift", TrialSettings(attempts=2, region="R1", together=2))
    session.press("record")
    for asked in script(session):
        session.carry_out(asked)
    session.press("record")
    while not (trial := session.status().verdict.trial).finished:  # type: ignore[union-attr]
        time.sleep(0.1)
    assert (trial.done, trial.successes, trial.error) == (2, 2, "")
    session.press("save")
    assert demonstrations.load(tmp_path / "lift", TASK).metadata["trial"]["successes"] == 2
    session.close()


def test_a_recording_that_nothing_can_be_generated_from_is_refused_with_the_reason(tmp_path: Path) -> None:
    session = make_session(tmp_path / "lift")
    session.press("record")
    for asked in script(session):
        session.carry_out(asked)
    session.press("record")
    assert session._review is not None
    session._review.report = TrialReport(attempts=20, done=20, successes=0, reasons=(("dropped: too wide", 20),))
    with pytest.raises(DemonstrationError, match=r"none of 20 attempts .* dropped: too wide"):
        session.press("save")
    session._review.report = TrialReport(attempts=20, done=0, successes=0, error="the palms are too far apart")
    with pytest.raises(DemonstrationError, match="too far apart"):
        session.press("save")
    assert session.status().state == "review" and not (tmp_path / "lift").exists()
    # A process that was ended from outside says nothing of the demonstration.
    session._review.report = TrialReport(attempts=20, done=6, successes=0, error="ended with exit code -9", died=True)
    session.press("save")
    assert demonstrations.load(tmp_path / "lift", TASK).metadata["trial"]["error"] == "ended with exit code -9"
    session.close()


def test_a_head_that_goes_down_and_ahead_takes_torso_and_gaze_along(tmp_path: Path) -> None:
    """As in the paper: the torso follows the head's pose, the neck keeps looking at the object."""
    session = make_session(tmp_path / "head")
    heads = [poses.pose([0.0, 0.0, 1.6]), poses.pose([0.15, 0.0, 1.35])]
    before = session.view()
    for number in range(30):
        head = poses.interpolate(heads[0], heads[1], np.array(min(1.0, number / 15)))
        hand = HandControls(pose=poses.pose([0.3, -0.2, 1.0]), engaged=True)
        session.advance(Controls(right=hand, head=head))
    after = session.view()
    assert before.T_world_head[2, 3] - after.T_world_head[2, 3] > 0.1
    assert session.sim.command[0, command.PITCH] > 0.15
    np.testing.assert_allclose(after.T_world_hands[1, :3, 3], before.T_world_hands[1, :3, 3], atol=0.04)
    seen = (poses.invert(after.T_world_head) @ after.T_world_objects["box"])[:3, 3]  # x is where the camera looks
    assert abs(seen[1]) < 0.05 * seen[0] and abs(seen[2]) < 0.05 * seen[0]
    session.close()


def test_buttons_that_do_nothing_and_recordings_that_cannot_be_saved(tmp_path: Path) -> None:
    session = make_session(tmp_path / "none")
    with pytest.raises(SessionError, match="'rewind' while the session is idle"):
        session.press("rewind")
    session.press("record")
    for _ in range(12):
        session.advance(Controls())
    session.press("record")
    status = session.status()
    assert status.state == "review" and "no hand touches anything" in status.verdict.refusal  # type: ignore[union-attr]
    with pytest.raises(DemonstrationError, match="no hand touches anything"):
        session.press("save")
    session.press("rewind")
    assert (session.status().state, session.status().tick) == ("recording", 0)
    session.press("record")  # there is no row
    assert "no hand touches anything" in session.status().verdict.refusal  # type: ignore[union-attr]
    session.press("discard")
    assert session.status().state == "idle"
    assert not (tmp_path / "none").exists()
    session.close()


def test_a_robot_that_squats_stays_down_when_it_goes_back_and_when_it_is_taken_up(tmp_path: Path) -> None:
    session = make_session(tmp_path / "squat")
    session.press("record")
    for _ in range(10):
        session.advance(Controls(lift=-1.0))
    lowered = session.clutch.squat
    for _ in range(REWIND_TICKS):
        session.advance(Controls())
    session.press("rewind")
    assert session.clutch.squat == lowered == pytest.approx(-0.2)
    session.advance(Controls())
    session.advance(Controls(lift=1.0))
    head = session.recorder.rows[-1]["head_target"]
    assert head is not None and head[2, 3] - session.recorder.rows[-2]["head_target"][2, 3] == pytest.approx(0.02)
    session.close()
    session = make_session(tmp_path / "squat")
    session.press("recover")
    assert lowered - 0.1 < session.clutch.squat < 0.5 * lowered
    session.close()


def test_who_goes_back_to_the_beginning_holds_what_was_held_then(tmp_path: Path) -> None:
    session = make_session(tmp_path / "low")
    for _ in range(10):
        session.advance(Controls(lift=-1.0))
    lowered = session.clutch.squat
    session.press("record")
    session.advance(Controls(lift=1.0))
    session.press("rewind")
    assert len(session.recorder) == 0 and session.clutch.squat == lowered < 0.0
    session.close()


def test_a_demonstration_begins_after_the_walk_and_before_the_motion(tmp_path: Path) -> None:
    session = make_session(tmp_path / "walk")
    session.press("record")
    for _ in range(4):
        session.advance(Controls(walk=np.array([0.6, 0.0, 0.0])))
    for asked in script(session):
        session.carry_out(asked)
    session.press("record")
    review = session._review
    assert review is not None and review.demonstration is not None, review
    assert len(review.demonstration) < len(session.recorder)
    assert not review.demonstration.action[:, :3].any()
    assert replay(review.demonstration).identical
    session.close()


@pytest.mark.parametrize("damage", ["half", "no command", "no start", "no facts"])
def test_a_damaged_recording_is_said_to_be(tmp_path: Path, damage: str) -> None:
    journal = Journal(tmp_path / "lift.unfinished")
    last = np.zeros(command.SIZE)
    journal.begin({"physics": np.zeros(100)}, last, {"start": {}})
    journal.append(last, np.zeros((2, 7)), None)
    journal.close()
    assert journal.find() is not None
    arrays, facts = journal.directory / "start.npz", journal.directory / "start.json"
    if damage == "half":
        arrays.write_bytes(arrays.read_bytes()[: arrays.stat().st_size // 2])
    elif damage == "no command":
        np.savez(arrays, allow_pickle=False, physics=np.zeros(100))
    else:
        facts.write_text("{}" if damage == "no start" else "[]")
    with pytest.raises(DemonstrationError, match="damaged"):
        journal.find()


def test_a_recording_that_was_not_taken_up_is_kept(tmp_path: Path) -> None:
    session = make_session(tmp_path / "lift")
    session.press("record")
    session.carry_out(next(script(session)))
    session.close()
    rows = (tmp_path / "lift.unfinished" / "rows.bin").read_bytes()
    for number, button in enumerate(("discard", "record"), start=1):
        session = make_session(tmp_path / "lift")
        assert session.status().unfinished == 1
        session.press(button)
        kept = tmp_path / f"lift.unfinished.{number}"
        assert kept.name in session.status().message and session.status().unfinished == 0
        assert (kept / "rows.bin").read_bytes() == rows
        session.close()
        shutil.rmtree(tmp_path / "lift.unfinished", ignore_errors=True)
        shutil.copytree(kept, tmp_path / "lift.unfinished")  # as its warning says
    assert make_session(tmp_path / "lift").status().unfinished == 1


class Disk(io.FileIO):
    """A file whose disk may be full."""

    full = False

    def write(self, content: Buffer) -> int:  # type: ignore[override]
        if self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(content)


def test_a_full_disk_stops_the_recording_until_there_is_room_and_no_step_is_lost(tmp_path: Path) -> None:
    session = make_session(tmp_path / "lift")
    session.press("record")
    disk = Disk(session.journal.directory / "rows.bin", "r+b")
    session.journal.close()
    session.journal._file = io.BufferedWriter(disk)
    session.advance(ENGAGED)
    disk.full = True
    session.advance(ENGAGED)
    assert session.paused and "No space left" in session.status().message
    session.advance(Controls())
    session.advance(ENGAGED)  # there is still none
    assert session.paused and len(session) == 3
    disk.full = False
    session.advance(Controls())
    session.advance(ENGAGED)
    assert not session.paused and session.status().message == "recording"
    made = [row["action"] for row in session.recorder.rows]
    session.close()
    found = Journal(session.journal.directory).find()
    assert found is not None
    np.testing.assert_array_equal(found.actions, np.array(made, dtype=np.float32))


def test_last_held() -> None:
    assert last_held(np.zeros(0, dtype=bool)) is None
    assert last_held(np.ones(HOLD_STEPS - 1, dtype=bool)) is None
    success = np.zeros(30, dtype=bool)
    assert last_held(success) is None
    success[5 : 5 + HOLD_STEPS] = True
    assert last_held(success) == 5 + HOLD_STEPS
    success[-3:] = True
    assert last_held(success) == 5 + HOLD_STEPS


@pytest.mark.parametrize("fact", ["task", "model_hash", "controller_hash"])
def test_a_recording_that_cannot_be_made_again_here_is_set_aside_and_kept(tmp_path: Path, fact: str) -> None:
    session = make_session(tmp_path / "lift")
    session.press("record")
    session.carry_out(next(script(session)))
    session.close()
    facts = tmp_path / "lift.unfinished" / "start.json"
    facts.write_text(json.dumps(json.loads(facts.read_text()) | {fact: "another"}))
    rows = (tmp_path / "lift.unfinished" / "rows.bin").read_bytes()
    session = make_session(tmp_path / "lift")
    assert session.found is None
    session.press("record")
    session.press("discard")
    session.close()
    assert (tmp_path / "lift.unfinished.1" / "rows.bin").read_bytes() == rows


def test_a_trial_whose_process_dies_says_so_and_leaves_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    trial = Trial(task=TASK, demonstration=demonstrations.load(None, TASK))
    assert os.environ["OMP_NUM_THREADS"] == "3"
    trial._process.kill()
    until = time.monotonic() + 60.0
    while not (report := trial.report()).finished and time.monotonic() < until:
        time.sleep(0.01)
    assert "exit code -9" in report.error and report.died and not report.hopeless
    trial.close()
