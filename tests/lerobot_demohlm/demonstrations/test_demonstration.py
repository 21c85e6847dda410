"""Demonstrations survive the disk bit for bit, replay bit for bit, and say clearly what is wrong with them."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.errors import DemonstrationError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import FPS
from lerobot_demohlm.checks import portability
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.replay import JOINT_BOUND, replay
from lerobot_demohlm.teleop.record import record, register_script, script_of

TASK = get_task("LiftBox")


@pytest.fixture(scope="module")
def demonstration() -> Demonstration:
    return demonstrations.load(task=TASK)


@pytest.fixture(scope="module")
def recorded() -> Demonstration:
    """Return what ``demohlm record`` makes here: processors of other families differ in the last bits."""
    script = script_of(TASK)
    return record(TASK, script.make_operator(), script.start)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return a copy of the packaged demonstration that a test may spoil."""
    return Path(shutil.copytree(demonstrations.default_root(TASK), tmp_path / "demonstration"))


def change_metadata(root: Path, **changes: object) -> None:
    path = root / demonstrations.META_PATH
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_it_succeeds_and_holds(demonstration: Demonstration) -> None:
    assert demonstration.success[-10:].all()
    assert not demonstration.success[:20].any()
    assert demonstration.metadata["operator"].startswith("scripted")


def test_save_and_load_keep_every_bit(demonstration: Demonstration, tmp_path: Path) -> None:
    root = tmp_path / "again"
    demonstration.save(root, TASK)
    again = demonstrations.load(root, TASK)
    assert again.content_hash == demonstration.content_hash
    assert again.action.tobytes() == demonstration.action.tobytes()
    assert again.hand_targets.tobytes() == demonstration.hand_targets.tobytes()
    assert {name: array.tobytes() for name, array in again.start.items()} == {
        name: array.tobytes() for name, array in demonstration.start.items()
    }
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


def test_it_is_a_lerobot_dataset(demonstration: Demonstration) -> None:
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("demohlm/demonstration", root=demonstrations.default_root(TASK))
    assert dataset.num_episodes == 1
    assert dataset.num_frames == len(demonstration)
    assert dataset.fps == FPS
    item = dataset[5]
    assert item["task"] == TASK.description
    np.testing.assert_array_equal(item["action"].numpy(), demonstration.action[5])
    names = dataset.meta.features["observation.state"]["names"]
    assert len(set(names)) == len(names) == 68


def test_poses_are_consistent(demonstration: Demonstration) -> None:
    """The matrices are rigid, and the hands end up on both sides of the box."""
    R = demonstration.T_world_hands[..., :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    left, right = demonstration.T_world_hands[-1, :, :3, 3]
    box = demonstration.T_world_objects[-1, 0, :3, 3]
    assert left[1] > box[1] > right[1]
    assert np.linalg.norm(left - right) == pytest.approx(0.26, abs=0.02)
    np.testing.assert_array_equal(demonstration.joint_positions, demonstration.state[:, :29])


def test_replay_gives_the_same_bits(recorded: Demonstration) -> None:
    outcome = replay(recorded)
    assert outcome.remarks == outcome.other_versions == ()
    assert outcome.identical
    assert outcome.agrees
    assert outcome.success
    assert outcome.num_ticks == len(recorded)


def test_replay_notices_a_changed_command(recorded: Demonstration) -> None:
    action = recorded.action.copy()
    action[10, 7] += np.float32(1e-3)
    outcome = replay(dataclasses.replace(recorded, action=action))
    assert outcome.first_difference == 11
    assert not outcome.identical
    assert not outcome.agrees
    assert outcome.largest_difference > 1e-6
    assert "bits must agree under equal versions" in outcome.lines()[-1]


def test_under_other_versions_replay_compares_within_bounds(recorded: Demonstration) -> None:
    versions = recorded.metadata["versions"] | {"mujoco": "3.10.0"}
    del versions["eigenpy"]  # as in files of earlier versions
    older = dataclasses.replace(recorded, metadata=recorded.metadata | {"versions": versions})
    outcome = replay(older)
    assert outcome.identical and outcome.agrees  # the bits are this machine's
    assert [line.split()[0] for line in outcome.other_versions] == ["mujoco", "eigenpy"]
    action = recorded.action.copy()
    action[10, 7] += np.float32(1e-3)
    near = replay(dataclasses.replace(older, action=action))
    assert near.agrees and not near.identical
    assert 1e-6 < near.largest_difference <= JOINT_BOUND
    assert "within the bounds for other versions" in near.lines()[-1]
    action[40:, 9:16] += np.float32(0.3)  # the left arm lets go
    far = replay(dataclasses.replace(older, action=action))
    assert not far.agrees
    assert "outside the bounds for other versions" in far.lines()[-1]


def test_an_end_unlike_the_recorded_one_is_outside_the_bounds(recorded: Demonstration) -> None:
    versions = recorded.metadata["versions"] | {"numpy": "1.0"}
    failed = recorded.success.copy()
    failed[-1] = False
    older = dataclasses.replace(recorded, metadata=recorded.metadata | {"versions": versions}, success=failed)
    end = {name: array.copy() for name, array in recorded.end.items()}
    end[next(iter(end))].flat[0] += 1.0
    outcome = replay(dataclasses.replace(older, end=end))
    assert outcome.largest_difference == 0.0
    assert not outcome.agrees
    assert "unlike the recording" in outcome.lines()[-1]


def test_recording_again_gives_the_same_bits(recorded: Demonstration) -> None:
    script = script_of(TASK)
    assert record(TASK, script.make_operator(), script.start).content_hash == recorded.content_hash


def test_recording_gives_the_packaged_demonstration(recorded: Demonstration, demonstration: Demonstration) -> None:
    """The packaged files are what ``demohlm record`` makes of the script, the controller and the model as they are."""
    assert replay(demonstration).agrees
    if portability.differing_versions():  # other bits: both end in success, near each other
        assert abs(len(recorded) - len(demonstration)) <= 2
        ticks = min(len(recorded), len(demonstration))
        joints = recorded.joint_positions[:ticks] - demonstration.joint_positions[:ticks]
        assert np.abs(joints).max() < 10 * JOINT_BOUND
    else:
        assert recorded.content_hash == demonstration.content_hash


def test_an_existing_root_is_left_alone(demonstration: Demonstration, tmp_path: Path) -> None:
    root = tmp_path / "taken"
    root.mkdir()
    with pytest.raises(DemonstrationError, match="exists"):
        demonstration.save(root, TASK)
    assert list(root.iterdir()) == []


def test_it_is_saved_as_of_its_own_task(demonstration: Demonstration, tmp_path: Path) -> None:
    with pytest.raises(DemonstrationError, match="got the task PressCube; expected LiftBox"):
        demonstration.save(tmp_path / "new", get_task("PressCube"))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_half_written(demonstration: Demonstration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        demonstration.save(tmp_path / "new", TASK)
    assert list(tmp_path.iterdir()) == []


def test_missing_files_are_named(tmp_path: Path, copied: Path) -> None:
    with pytest.raises(DemonstrationError, match=r"demonstration\.json"):
        demonstrations.load(tmp_path / "nowhere", TASK)
    (copied / demonstrations.SNAPSHOTS_PATH).unlink()
    with pytest.raises(DemonstrationError, match="damaged"):
        demonstrations.load(copied, TASK)


def test_damaged_files_are_noticed(copied: Path) -> None:
    (copied / demonstrations.META_PATH).write_text("{")
    with pytest.raises(DemonstrationError, match="damaged"):
        demonstrations.load(copied, TASK)


@pytest.mark.parametrize("text", ["", '{"segments": [{"hand": "left" "kind": "object"}]}'])
def test_corrections_that_are_no_json_are_named_and_the_recording_is_not_blamed(copied: Path, text: str) -> None:
    (copied / demonstrations.CORRECTIONS_PATH).write_text(text)
    with pytest.raises(DemonstrationError, match=r"segments\.json, no JSON .* mend that file, or remove it"):
        demonstrations.load(copied, TASK)


def test_truncated_data_are_noticed(copied: Path) -> None:
    data = next((copied / "data").rglob("*.parquet"))
    data.write_bytes(data.read_bytes()[:-100])
    with pytest.raises(DemonstrationError, match="damaged"):
        demonstrations.load(copied, TASK)


def test_another_task_is_refused(copied: Path) -> None:
    change_metadata(copied, task="PushCube")
    with pytest.raises(DemonstrationError, match=r"PushCube.*LiftBox"):
        demonstrations.load(copied, TASK)


def test_a_task_that_is_not_installed_is_refused(copied: Path) -> None:
    change_metadata(copied, task="FlyToTheMoon")
    with pytest.raises(UnknownNameError, match="FlyToTheMoon"):
        demonstrations.load(copied)


def test_another_version_is_refused(copied: Path) -> None:
    change_metadata(copied, format_version=99)
    with pytest.raises(DemonstrationError, match="99"):
        demonstrations.load(copied, TASK)


def test_a_changed_hash_is_refused(copied: Path) -> None:
    change_metadata(copied, controller_hash="0" * 64)
    with pytest.raises(DemonstrationError, match="content hash"):
        demonstrations.load(copied, TASK)


def test_no_contact_is_refused(demonstration: Demonstration, tmp_path: Path) -> None:
    empty = dataclasses.replace(demonstration, contact_forces=np.zeros_like(demonstration.contact_forces))
    empty.save(tmp_path / "empty", TASK)
    with pytest.raises(DemonstrationError, match="without contact"):
        demonstrations.load(tmp_path / "empty", TASK)


def test_invalid_arrays_are_refused(demonstration: Demonstration) -> None:
    with pytest.raises(DemonstrationError, match="ticks"):
        dataclasses.replace(demonstration, success=demonstration.success[:-1])
    state = demonstration.state.copy()
    state[3, 3] = np.nan
    with pytest.raises(DemonstrationError, match="NaN"):
        dataclasses.replace(demonstration, state=state)


def test_a_task_without_a_script_says_which_there_are() -> None:
    with pytest.raises(UnknownNameError, match="lift_box"):
        script_of(dataclasses.replace(TASK, name="LiftBoxes"))


def test_a_script_may_come_from_outside() -> None:
    task = dataclasses.replace(TASK, name="LiftBoxByHand")
    script = script_of(TASK)
    register_script(task, script)
    register_script(task, script)
    assert script_of(task) is script
    with pytest.raises(DemonstrationError, match="second script"):
        register_script(task, dataclasses.replace(script, start=TASK.default_state()))
