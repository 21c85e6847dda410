"""Which policies may drive a robot."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gym_demohlm.errors import PolicyError, UnknownNameError
from lerobot_demohlm.hardware import policy_process
from lerobot_demohlm.hardware.policy_process import check_policy


def trained(folder: Path, region: str | None, task: str = "LiftBox") -> Path:
    """Make a checkpoint as far as it tells of its dataset, which is gone where it has no region; returns its path."""
    root = folder / "data"
    (folder / "train_config.json").write_text(json.dumps({"dataset": {"root": str(root)}, "env": None}))
    if region is not None:
        (root / "meta").mkdir(parents=True)
        (root / "meta" / "demohlm.json").write_text(json.dumps({"task": task, "region": region}))
    return folder


@pytest.fixture(autouse=True)
def loads(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Have every policy load."""
    loaded = SimpleNamespace(needs_images=False)
    monkeypatch.setattr(policy_process, "load_policy", lambda *_: loaded)
    return loaded


@pytest.mark.parametrize(("region", "deployed"), [("R4", "R3"), ("R3", "R4")])
def test_a_policy_of_other_shapes_and_fronts_is_refused(region: str, deployed: str, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=f"trained in {region}.*deploy it with --region {region}"):
        check_policy(trained(tmp_path, region), "LiftBox", "cpu", deployed)


@pytest.mark.parametrize(
    ("task", "region", "deployed"),
    [
        ("LiftBox", "R4", "R4"),
        ("LiftBox", "R1", "R3"),
        ("LiftBox", None, "R4"),
        ("PushCart", "R4", "R3"),  # whose R4 has the same cart
    ],
)
def test_a_policy_of_the_same_shapes_or_of_data_that_is_gone_is_not(
    task: str, region: str | None, deployed: str, tmp_path: Path, loads: Any
) -> None:
    assert check_policy(trained(tmp_path, region, task), task, "cpu", deployed) is loads


def test_a_region_that_does_not_exist_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="R9"):
        check_policy(trained(tmp_path, "R3"), "LiftBox", "cpu", "R9")
