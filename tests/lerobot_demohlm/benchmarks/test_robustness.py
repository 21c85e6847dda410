"""A policy's success against each group of a variation, as lines, table and figure."""

from dataclasses import replace
from pathlib import Path

import pytest

from gym_demohlm import jsonl
from gym_demohlm.registry import get_task, register_task
from gym_demohlm.variation import get_variation
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.cli import main
from lerobot_demohlm.experiments.plan import STRENGTHS, graded
from lerobot_demohlm.experiments.robustness import measured
from tests.helpers.checkpoints import save_policy


def test_every_cell_is_a_variation() -> None:
    for group in GROUPS:
        for strength in STRENGTHS:
            ranges = get_variation(graded(group, strength)).ranges
            assert ranges and all(key.startswith(f"{group}.") for key in ranges)
    assert not get_variation(graded(None, 0.0))


def test_lines_become_a_table_and_a_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Who stands still succeeds in the plain world and where a group makes no difference."""
    patience = replace(
        get_task("LiftBox"), name="Patience", episode_length_s=1.2, success=lambda sim: sim.time > 0.1, failures={}
    )
    register_task(patience)
    policy, results, figure = save_policy(tmp_path / "policy"), tmp_path / "new" / "lines.jsonl", tmp_path / "new.png"
    call = ["benchmark", "robustness", "--policy", str(policy), "--task", "Patience", "--num-episodes", "2"]
    call += ["--groups", "objects", "--results", str(results), "--figure", str(figure)]
    assert main(call) == 0
    found = list(jsonl.read(results))
    assert [(line["group"], line["strength"]) for line in found] == [
        ("none", 0.0), ("objects", 0.5), ("objects", 1.0), ("objects", 1.5)
    ]  # fmt: skip
    assert all(line["episodes"] == 2 and line["success_strict"]["rate"] == 1.0 for line in found)
    row = next(text for text in capsys.readouterr().out.splitlines() if text.startswith("| Patience R3"))
    assert "| 100 | 100 / 100 / 100 | - / - / - |" in row
    assert figure.stat().st_size > 0
    other = [line | {"policy_hash": "another", "success_strict": {"rate": 0.5}} for line in found[:1]]
    jsonl.append(results, other)
    (row,) = measured(results)
    assert row.shares == {"none": (1, 2)}, "of two policies of a kind it is the one that was measured last"


@pytest.mark.parametrize("wrong", [["--groups", "weather"], ["--num-episodes", "0"]])
def test_what_cannot_be_measured_is_refused(wrong: list[str], tmp_path: Path) -> None:
    policy = save_policy(tmp_path / "policy")
    results = tmp_path / "lines.jsonl"
    assert main(["benchmark", "robustness", "--policy", str(policy), "--results", str(results), *wrong]) == 2
    assert not results.exists()
