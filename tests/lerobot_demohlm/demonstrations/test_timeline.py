"""A timeline's figure shows what every hand follows; a sidecar written by hand is read, and nothing else may change."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from lerobot_demohlm import cli
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import CORRECTIONS_PATH, META_PATH, default_root
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.demonstrations.timeline import FOLLOWS, draw_timeline

TASK = get_task("LiftBox")


def test_the_figure_gives_each_segment_its_share() -> None:
    demonstration = demonstrations.load(task=TASK)
    pixels = np.asarray(draw_timeline(demonstration))
    segments = segment(demonstration, TASK)
    for kind, colour in FOLLOWS.items():
        ticks = sum(entry.stop - entry.start for entry in segments if entry.kind == kind)
        columns = (pixels == colour).all(axis=-1)
        share = columns.any(axis=0).sum() / (np.isin(pixels, list(FOLLOWS.values())).all(axis=-1).any(axis=0).sum())
        assert share == pytest.approx(ticks / (2 * len(demonstration)), abs=0.03)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    root = tmp_path / "lift_box"
    shutil.copytree(default_root(TASK), root)
    return root


def test_a_person_corrects_the_segments(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = demonstrations.load(copied)
    figure = tmp_path / "pictures" / "timeline.png"
    arguments = ["segment", "--task", "LiftBox", "--root", str(copied), "--figure", str(figure)]
    assert cli.main([*arguments, "--write-corrections"]) == 0
    assert figure.stat().st_size > 1000 and "box" in capsys.readouterr().out
    path = copied / CORRECTIONS_PATH
    again = demonstrations.load(copied)
    assert segment(again, TASK) == segment(found, TASK)
    content = json.loads(path.read_text())
    for entry in content["segments"]:
        entry["anchor"] = "root"
    path.write_text(json.dumps(content))
    corrected = demonstrations.load(copied)
    assert {entry.anchor for entry in segment(corrected, TASK)} == {"root"}
    assert corrected.recording_hash == found.recording_hash == found.content_hash
    assert corrected.content_hash != found.content_hash


def test_a_changed_recording_is_still_noticed(copied: Path) -> None:
    content = json.loads((copied / META_PATH).read_text())
    (copied / META_PATH).write_text(json.dumps(content | {"controller_hash": "0"}))
    with pytest.raises(DemonstrationError, match="content hash"):
        demonstrations.load(copied)
