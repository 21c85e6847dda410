"""Ready cards: one a task, rendered from its facts, and each says that data is simulated, its sensors and limits."""

import json
import shutil
from pathlib import Path

import pytest

from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm import cli
from lerobot_demohlm.datasets import card, writer
from tests.helpers.paths import REPOSITORY

FOLDER = REPOSITORY / "dataset_cards"
NAMES = {task.slug: name for name, task in all_tasks().items() if task.module.startswith("gym_demohlm")}


def test_every_task_has_a_ready_card() -> None:
    assert {path.stem for path in FOLDER.glob("*.md")} == set(NAMES)
    assert {path.stem for path in (FOLDER / card.FACTS_FOLDER).glob("*.json")} == set(NAMES)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_ready_card_is_what_would_be_pushed(name: str) -> None:
    values = json.loads((FOLDER / card.FACTS_FOLDER / f"{name}.json").read_text())
    text = (FOLDER / f"{name}.md").read_text()
    assert text == card.render_values(values), "run: demohlm card"
    facts = values["facts"]
    assert facts["task"] == NAMES[name]
    assert facts["task_text"] == get_task(NAMES[name]).description
    assert facts["successes"] == values["info"]["total_episodes"]
    for key, feature in writer.features(NAMES[name]).items():
        assert values["features"][key] == {**feature, "shape": list(feature["shape"])}, "the features of today's code"
    for words in (
        "**Simulated data.**",
        "## Sensors",
        "No images",
        "## Limits",
        f"| Successes | {facts['successes']} (",
    ):
        assert words in text


def test_a_card_tells_of_pictures_varied_worlds_and_eyes() -> None:
    values = json.loads((FOLDER / card.FACTS_FOLDER / "lift_box.json").read_text())
    values["facts"] |= {"variation": "real:objects+robot", "perception": "rgbd", "wordings": True}
    values["facts"] |= {"pictures": {"cameras": ["head:96x96:rgb"], "light": 0.5}}
    blind = card.render_values(values)
    assert "No images" in blind, "failed attempts have no pictures, whatever their run draws"
    video = {"dtype": "video", "shape": [96, 96, 3], "names": ["height", "width", "channel"]}
    text = card.render_values({**values, "features": {**values["features"], "observation.images.head": video}})
    for words in (
        "Pictures of head:96x96:rgb; no forces",
        "these groups vary, too: objects, robot.",
        "what `rgbd` sees of it",
        "| Variation | `real:objects+robot` |",
        "| Cameras | head:96x96:rgb, light 0.5 |",
        "| Sentence | the task in several wordings |",
    ):
        assert words in text
    for words in ("No images", "without error or delay", "Only the start varies", "these exact poses"):
        assert words not in text


def test_all_cards_are_rendered_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "cards"
    shutil.copytree(FOLDER / card.FACTS_FOLDER, folder / card.FACTS_FOLDER)
    assert cli.main(["card", "--folder", str(folder)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(NAMES)
    for name in NAMES:
        assert (folder / f"{name}.md").read_text() == (FOLDER / f"{name}.md").read_text()
    with pytest.raises(DatasetError, match="without facts"):
        card.render_ready_cards(tmp_path)
    assert cli.main(["card", "--repo-id", "user/name"]) == 2


def test_the_card_of_a_dataset_becomes_a_ready_one(small_run: Path, tmp_path: Path) -> None:
    path = card.write_ready_card(small_run, "user/lift_box", tmp_path)
    assert path == tmp_path / "lift_box.md"
    assert 'LeRobotDataset("user/lift_box")' in path.read_text()
    assert card.render_ready_cards(tmp_path) == [path]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"facts": {}, "features": {}, "ends": []}'])
def test_damaged_facts_are_named_and_the_card_stays(text: str, tmp_path: Path) -> None:
    (tmp_path / card.FACTS_FOLDER).mkdir()
    (tmp_path / card.FACTS_FOLDER / "lift_box.json").write_text(text)
    (tmp_path / "lift_box.md").write_text("card")
    with pytest.raises(DatasetError, match=r"lift_box\.json, damaged"):
        card.render_ready_cards(tmp_path)
    assert (tmp_path / "lift_box.md").read_text() == "card"
