"""Lines of perturbed operators: measured once, read back, and shown as a table."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import perturbed
from lerobot_demohlm.benchmarks.perturbed import PerturbedLine, measure, read, table
from lerobot_demohlm.checks import portability
from tests.helpers.paths import REPOSITORY

LINE = PerturbedLine(
    task="PressCube", operator=0, region="R3", attempts=20, successes=19, trial=20, tries=2, failed=1, steps=90,
    delay_ms=100.0, reasons=[["timeout: never", 1]], refusal="", stamp="", recording="abc",
)  # fmt: skip


def test_the_table_counts_what_the_lines_say() -> None:
    worse = replace(LINE, operator=1, successes=10, tries=1)
    refused = replace(LINE, operator=2, successes=0, refusal="no success")
    assert LINE.good and not worse.good and not refused.good
    shorter, earlier = replace(LINE, trial=10, successes=12), replace(LINE, stamp="of another model", successes=3)
    other = replace(refused, task="PushCart")
    lines = [shorter, earlier, LINE, worse, refused, other, replace(LINE, task="LiftBox")]
    assert table(lines, ["PressCube", "PushCart", "PushCube"]).splitlines()[2:] == [
        "| PressCube * | 20 | 3 | 1 | 1 | 40 | 72.5 | 50 | 3 | 2 |",
        "| PushCart * | 20 | 1 | 1 | 0 | 0 | - | - | - | - |",
    ]
    today = [replace(line, stamp=portability.stamp(get_task("PressCube"))) for line in (LINE, worse, refused)]
    assert table([shorter, *today], ["PressCube"]).splitlines()[2].startswith("| PressCube | 20 | 3 |")


def test_what_is_there_is_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task, path = get_task("PressCube"), tmp_path / "lines.jsonl"
    known = replace(LINE, stamp=portability.stamp(task))
    jsonl.append(path, [asdict(known)])
    measured = []

    def stand_in(_task: object, operator: int, *_: object) -> dict[str, object]:
        measured.append(operator)
        return asdict(replace(known, operator=operator))

    monkeypatch.setattr(perturbed, "_measure", stand_in)
    lines = list(measure([task], range(3), 20, path, tmp_path / "root"))
    assert [line.operator for line in lines] == [0, 1, 2]
    assert measured == [1, 2]
    assert read(path) == lines
    with pytest.raises(DatasetError, match="attempts=0"):
        list(measure([task], [0], 0, path, tmp_path / "root"))


def test_the_documented_table_is_that_of_the_results() -> None:
    lines = read(REPOSITORY / "results/perturbed.jsonl")
    text = (REPOSITORY / "docs/teleoperation.md").read_text()
    shown = text.partition("<!-- perturbed -->")[2].partition("<!-- /perturbed -->")[0]
    assert shown.strip() == table(lines, list(dict.fromkeys(line.task for line in lines)))
