"""Generation that records what a robot's eyes see, and its verification."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_demohlm.errors import DatasetError, UnknownNameError
from gym_demohlm.registry import get_task
from lerobot_demohlm.checks.verify import mismatches, verify
from lerobot_demohlm.datasets.facts import FACTS_PATH, PERCEPTION_FIT, read_facts
from lerobot_demohlm.datasets.variation import PLAIN, DataVariation
from lerobot_demohlm.datasets.writer import read_arrays
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.runner import generate

TASK = get_task("LiftBox")
STATE, OBJECTS = "observation.state", "observation.environment_state"


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exact") / "data"
    _generated(root)
    return root


def _generated(root: Path, **knobs: Any) -> list[dict[str, np.ndarray]]:
    cameras = ("head:32x32:rgb,depth",) if "variation" in knobs else None
    request = GenerationRequest(
        task=TASK.name, region="R1", seed=5, root=root, num_attempts=2, block_size=2, cameras=cameras,
        variation=DataVariation(command_noise=0.0, **knobs), show_progress=False,
    )  # fmt: skip
    assert generate(request).successes == 2
    return list(read_arrays(root))


def test_a_perception_that_cannot_be_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'rgbd'"):
        DataVariation(perception="rgdb")
    with pytest.raises(DatasetError, match="choose rgbd"):
        DataVariation(perception="remote")
    assert "perception" not in PLAIN.content()
    assert DataVariation.read(DataVariation(perception="model").content()).perception == "model"


def test_errors_of_a_model_are_recorded_and_repeated(exact: Path, tmp_path: Path) -> None:
    seen = _generated(tmp_path / "seen", perception="model")
    for plain, other in zip(read_arrays(exact), seen, strict=True):
        count = min(len(plain[OBJECTS]), len(other[OBJECTS]))
        off = np.linalg.norm(plain[OBJECTS][:count, :3] - other[OBJECTS][:count, :3], axis=1)
        assert 0.0 < off[0] < 0.02
        assert (plain[STATE][1:count] != other[STATE][1:count]).any()  # the neck turns to where the box seems to be
    facts = read_facts(tmp_path / "seen")
    assert facts["perception"] == "model" and PERCEPTION_FIT not in read_facts(exact)
    assert verify(tmp_path / "seen", TASK).identical
    assert verify(tmp_path / "seen", TASK, [1]).identical  # alone as among others
    (tmp_path / "seen" / FACTS_PATH).write_text(json.dumps(facts | {PERCEPTION_FIT: "0" * 64}))
    assert any(line.startswith(PERCEPTION_FIT) for line in mismatches(read_facts(tmp_path / "seen"), TASK))
    (tmp_path / "seen" / FACTS_PATH).write_text(json.dumps(facts | {"perception": "exact"}))
    assert {each.field for each in verify(tmp_path / "seen", TASK, [0]).differences} == {OBJECTS}


@pytest.mark.slow
def test_what_a_tracker_sees_of_varied_worlds_is_recorded_and_drawn_and_repeated(tmp_path: Path) -> None:
    _generated(tmp_path / "seen", perception="rgbd", variation="real@0.5:objects+scene")
    assert verify(tmp_path / "seen", TASK).identical


def test_what_episodes_draw_of_their_eyes_is_recorded_and_repeated(exact: Path, tmp_path: Path) -> None:
    """The group ``perception`` of a variation has the fitted errors; datasets from before it keep exact poses."""
    root = tmp_path / "seen"
    drawn = DataVariation(command_noise=0.0, variation="real:perception")
    request = GenerationRequest(
        task=TASK.name, region="R1", seed=5, root=root, num_attempts=2, variation=drawn, show_progress=False
    )
    assert generate(request).successes == 2
    facts, (plain, *_) = read_facts(root), read_arrays(exact)
    assert facts[PERCEPTION_FIT] and "perception" not in facts
    off = np.linalg.norm(next(iter(read_arrays(root)))[OBJECTS][0, :3] - plain[OBJECTS][0, :3])
    assert 0.0 < off < 0.03
    assert verify(root, TASK).identical
