"""Probes of generation: what is in a file is not measured again, unless what it stands for has changed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm import jsonl
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import feedback, tally, variation
from lerobot_demohlm.checks import portability
from lerobot_demohlm.cli import main
from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.probe_tables import AGED, feedback_table, variation_table
from lerobot_demohlm.generation import stages

TASK = get_task("LiftBox")


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Make attempts that all succeed in no time, and count them; digests of other worlds are made up too."""
    made: list[str] = []

    def attempt(task: Any, settings: stages.Settings, region: str, seed: int, count: int) -> dict[str, Any]:
        made.append(settings.variation.variation)
        values = {"task": task.name, "variation": settings.variation.variation, "region": region, "seed": seed}
        return values | {"attempts": count, "successes": count, "strict": 1, "reasons": [], "cpu_ms_step": 1.0}

    monkeypatch.setattr(variation, "tally", attempt)
    monkeypatch.setattr(feedback, "tally", attempt)
    monkeypatch.setattr(portability, "_varied", lambda *words: f"{hash(words):016x}"[-8:])
    return made


def test_probes_are_made_once(tmp_path: Path, counted: list[str]) -> None:
    path = tmp_path / "variation.jsonl"
    for _ in range(2):
        lines = list(variation.measure([TASK], ["none", "real:objects"], 4, path))
    assert counted == ["none", "real:objects"] and [line.strict for line in lines] == [1, 1]
    assert list(jsonl.read_as(variation.Probe, path)) == lines


def test_other_adaptation_makes_lines_of_varied_worlds_old(
    tmp_path: Path, counted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And leaves those of plain ones as they are."""
    path = tmp_path / "variation.jsonl"
    list(variation.measure([TASK], ["none", "real:objects"], 4, path))
    lines = [Measurement(values=line, command="", commit="") for line in jsonl.read(path)]
    assert AGED not in variation_table(lines)
    before = portability.recipe("real")
    stronger = replace(stages.AdaptationSettings(), squeeze=3.0)
    monkeypatch.setattr(portability, "Settings", lambda: stages.Settings(adaptation=stronger))
    portability.recipe.cache_clear()
    assert portability.recipe("real") != before
    (row,) = (text for text in variation_table(lines).splitlines() if text.startswith("| LiftBox"))
    assert row == f"| LiftBox | 25 % of 4 | 25 % of 4{AGED} |"
    list(variation.measure([TASK], ["none", "real:objects"], 4, path))
    assert counted == ["none", "real:objects", "real:objects"]
    portability.recipe.cache_clear()


def test_stamps_say_which_worlds(counted: list[str]) -> None:
    assert not counted
    assert portability.worlds_stamp(TASK, "none", "R1") == ""
    real = portability.worlds_stamp(TASK, "real", "R3")
    assert len(real) == 16 and real == portability.worlds_stamp(TASK, "real@0.5:pushes", "R2")
    others = [portability.worlds_stamp(TASK, *rest) for rest in (("hard", "R3"), ("real", "R4"), ("none", "R4"))]
    assert len({real, *others}) == 4


def test_the_ways_to_replay_become_a_table(
    tmp_path: Path, counted: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["benchmark", "feedback", "--tasks", "LiftBox-v0", "--num-attempts", "2", "--results", str(tmp_path)]
    assert main(call) == 0
    plain = [name for name, replay in feedback.REPLAYS.items() if replay.in_plain]
    assert counted == ["none"] * len(plain) + ["real"] * len(feedback.REPLAYS)
    lines = [Measurement(values=line, command="", commit="") for line in jsonl.read(tmp_path / "feedback.jsonl")]
    shown = capsys.readouterr().out
    assert feedback_table(lines) in shown
    rows = [text.split(" | ")[0] for text in shown.splitlines() if text.startswith("| `")]
    assert rows == [f"| `{name}`" for name in (*plain, *feedback.REPLAYS)]


def test_each_way_to_replay_is_another_one() -> None:
    """And one that is the same in the plain world differs from ours in what only worlds that vary make count."""
    ours = feedback.REPLAYS["ours"].settings("real")
    found = [(replay.settings("real"), replay.symmetric) for replay in feedback.REPLAYS.values()]
    assert all(found.index(entry) == index for index, entry in enumerate(found))
    for replay in feedback.REPLAYS.values():
        settings = replay.settings("real")
        assert replay.in_plain or replace(settings, adaptation=ours.adaptation) == ours


@pytest.mark.parametrize(
    "wrong",
    [["feedback", "--replays", "shut"], ["feedback", "--num-attempts", "0"], ["variation", "--num-attempts", "0"]],
)
def test_what_cannot_be_measured_is_refused(wrong: list[str], tmp_path: Path) -> None:
    assert main(["benchmark", *wrong, "--results", str(tmp_path)]) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_attempts_are_counted() -> None:
    found = tally.tally(TASK, feedback.REPLAYS["open"].settings("none"), "R1", 5, 2)
    assert found["attempts"] == 2 and found["successes"] + sum(count for _, count in found["reasons"]) == 2
