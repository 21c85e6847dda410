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
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.replay import replay
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
    demonstration.save(root)
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
    assert outcome.remarks == ()
    assert outcome.identical
    assert outcome.num_ticks == len(recorded)


def test_replay_notices_a_changed_command(recorded: Demonstration) -> None:
    action = recorded.action.copy()
    action[10, 7] += np.float32(1e-3)
    outcome = replay(dataclasses.replace(recorded, action=action))
    assert outcome.first_difference == 11
    assert not outcome.identical
    assert outcome.largest_difference > 1e-6


def test_recording_again_gives_the_same_bits(recorded: Demonstration) -> None:
    script = script_of(TASK)
    assert record(TASK, script.make_operator(), script.start).content_hash == recorded.content_hash


def test_recording_gives_the_packaged_demonstration(recorded: Demonstration, demonstration: Demonstration) -> None:
    """The packaged files are what ``demohlm record`` makes of the script, the controller and the model as they are."""
    np.testing.assert_allclose(recorded.action, demonstration.action, atol=1e-4)
    np.testing.assert_allclose(recorded.state, demonstration.state, atol=1e-3)
    replayed = replay(demonstration)
    if not replayed.remarks:  # the same family of processors and the same libraries
        assert replayed.identical
        assert recorded.content_hash == demonstration.content_hash


def test_an_existing_root_is_left_alone(demonstration: Demonstration, tmp_path: Path) -> None:
    root = tmp_path / "taken"
    root.mkdir()
    with pytest.raises(DemonstrationError, match="exists"):
        demonstration.save(root)
    assert list(root.iterdir()) == []


def test_nothing_is_half_written(demonstration: Demonstration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        demonstration.save(tmp_path / "new")
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
    empty.save(tmp_path / "empty")
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
