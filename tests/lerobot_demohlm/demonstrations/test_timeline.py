"""A timeline's figure shows what every hand follows; a sidecar written by hand is read, and nothing else may change."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from gym_demohlm.timing import FPS
from lerobot_demohlm import cli, drawing
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.demonstration import CORRECTIONS_PATH, META_PATH, default_root
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.demonstrations.segments import Event
from lerobot_demohlm.demonstrations.timeline import FOLLOWS, Row, draw_timeline

TASK = get_task("LiftBox")


def test_the_figure_gives_each_segment_its_place() -> None:
    demonstration = demonstrations.load(task=TASK)
    figure, segments = draw_timeline(demonstration), segment(demonstration, TASK)
    bars = [
        (to_hex(bar.get_facecolor()), bar.get_x(), bar.get_x() + bar.get_width())
        for axes in figure.axes
        for bar in axes.patches
        if isinstance(bar, Rectangle)
    ]
    expected = [(FOLLOWS[entry.kind], entry.start / FPS, entry.stop / FPS) for entry in segments]
    assert [colour for colour, *_ in bars] == [colour for colour, *_ in expected]
    assert np.allclose([ends for _, *ends in bars], [ends for _, *ends in expected])
    assert "left hand on box [N]" in drawing.svg(figure)
    assert drawing.svg(figure) == drawing.svg(draw_timeline(demonstration)), "the same bytes on every run"


def test_events_stand_at_the_curve_of_their_own_object() -> None:
    names = ("cube", "cube_2")
    shown = [Row(hand="left", title=f"left hand on {name} [N]", values=np.zeros(3), object=name) for name in names]
    shown.append(Row(hand="left", title="left gripper closed", values=np.zeros(3)))
    found = [Event(tick=i, hand="left", kind="touch", object=name) for i, name in enumerate(names)]
    found += [Event(tick=2, hand="left", kind="close"), Event(tick=0, hand="right", kind="touch", object="cube")]
    assert [[event.tick for event in row.events_of(found)] for row in shown] == [[0], [1], [2]]
    assert Row(hand="left", title="left hand follows").events_of(found) == []


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
