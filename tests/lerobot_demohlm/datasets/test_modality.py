"""``meta/modality.json`` by the rules of GR00T's reader: what it names is there, whole, and what its name says."""

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm.datasets.modality import modality
from lerobot_demohlm.datasets.writer import features
from tests.helpers.drawn import write_drawn
from tests.helpers.groot_reader import COLUMNS, OPTIONAL, GrootReader


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> GrootReader:
    return GrootReader(write_drawn(tmp_path_factory.mktemp("modality") / "data"))


def test_every_entry_has_fields_that_the_reader_knows(reader: GrootReader) -> None:
    assert set(reader.modality) == {"state", "action", "video", "annotation"}
    for kind in COLUMNS:
        for entry in reader.modality[kind].values():
            assert type(entry["start"]) is int and type(entry["end"]) is int
            for name in set(entry) - {"start", "end"}:
                assert type(entry[name]) is OPTIONAL[name], name
    for kind in ("video", "annotation"):
        for name, entry in reader.modality[kind].items():
            assert set(entry) <= {"original_key"} and not name.startswith(f"{kind}.")


@pytest.mark.parametrize("kind", COLUMNS)
def test_parts_cover_each_vector_once_with_their_statistics(reader: GrootReader, kind: str) -> None:
    covered: dict[str, list[int]] = {}
    for name, entry in reader.modality[kind].items():
        values, statistics = reader.part(kind, name)
        assert values.dtype == np.float32 and values.shape == (len(reader.frames), entry["end"] - entry["start"])
        assert all(each.shape == values.shape[1:] for each in statistics.values())
        np.testing.assert_allclose(statistics["min"], values.min(axis=0), rtol=1e-6)
        covered.setdefault(entry.get("original_key", COLUMNS[kind]), []).extend(range(entry["start"], entry["end"]))
    for column, indices in covered.items():
        assert sorted(indices) == list(range(reader.features[column]["shape"][0]))
    vectors = {"state": {"observation.state", "observation.environment_state"}, "action": {"action"}}
    assert set(covered) == vectors[kind]


def test_a_part_has_the_numbers_of_its_name(reader: GrootReader) -> None:
    def names(kind: str, part: str) -> list[str]:
        entry = reader.modality[kind][part]
        return reader.features[entry["original_key"]]["names"][entry["start"] : entry["end"]]

    left_arm = [name for name in command.NAMES if name.startswith(("left_shoulder", "left_elbow", "left_wrist"))]
    assert names("action", "left_arm") == names("state", "left_arm") == left_arm
    assert names("state", "left_arm_velocity") == [name.replace(".pos", ".vel") for name in left_arm]
    assert names("action", "base_velocity") == ["base_x.vel", "base_y.vel", "base_yaw.vel"]
    assert reader.modality["action"]["base_velocity"]["absolute"] is False
    assert names("action", "right_gripper") == ["right_gripper.pos"]
    assert names("state", "torso") == ["torso_roll.pos", "torso_pitch.pos"]
    assert names("state", "box") == list(observation.environment_names(get_task("LiftBox")))


def test_videos_are_colour_pictures_and_depth_is_left_out(reader: GrootReader) -> None:
    assert list(reader.modality["video"]) == ["head"]
    key, size = reader.video("head")
    assert key == "observation.images.head" and size == {"height": 64, "width": 64, "channels": 3}
    assert reader.features[key]["info"]["video.fps"] == 10


def test_the_annotation_is_the_sentence_of_the_task(reader: GrootReader) -> None:
    (name,) = reader.modality["annotation"]
    assert reader.sentence(f"annotation.{name}", 3) == "Lift the box."


@pytest.mark.parametrize("name", sorted(all_tasks()))
def test_every_object_of_a_task_is_a_part(name: str) -> None:
    task = get_task(name)
    state = modality(features(name))["state"]
    sizes = {part: entry["end"] - entry["start"] for part, entry in state.items()}
    assert [sizes[entry.name] for entry in task.objects] == [9] * len(task.objects)
    assert len(state) == 17 + len(task.objects)


def test_a_number_of_no_limb_is_an_error() -> None:
    table = features("LiftBox")
    table["action"] = {**table["action"], "names": ["tail.pos", *command.NAMES[1:]]}
    with pytest.raises(DatasetError, match=r"tail\.pos"):
        modality(table)
