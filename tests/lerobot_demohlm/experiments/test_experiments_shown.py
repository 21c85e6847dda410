"""What is made of the lines of experiments: rates, tables, figures, a page."""

import dataclasses
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm.errors import UnknownNameError
from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm import cli
from lerobot_demohlm.experiments import lines, page, paper, plots, readme_tables, tables
from lerobot_demohlm.experiments.plan import plan, stamp
from lerobot_demohlm.policies.training import checkpoint
from lerobot_demohlm.reports import gallery
from tests.helpers.experiment_lines import CELL, layout, make_line


def test_rates() -> None:
    one = make_line(successes=200)
    assert tables.rate([one]) == (0.8, *tables.wilson(200, 250))
    mean, low, high = tables.rate([one, make_line(successes=250)])
    assert mean == 0.9
    assert 0.77 < low < 0.82  # two trainings that differ: the interval spans them
    assert 0.99 < high <= 1.0
    assert tables.rate([one, one]) == pytest.approx(tables.rate([one]), abs=0.03)
    mean, low, high = tables.rate([make_line(successes=0)] * 3)
    assert mean == low == 0.0
    assert 0.001 < high < 0.01
    mean, low, high = tables.mean_rate([[make_line(successes=200)]] * 10)
    assert mean == 0.8
    assert (low, high) == pytest.approx(tables.wilson(2000, 2500), abs=0.003)  # narrower than one task's


def lines_of_all() -> list[dict[str, Any]]:
    found = []
    for policy, size, seed, successes in (
        ("mlp", 100, 0, 100),
        ("mlp", 100, 1, 120),
        ("mlp", 1000, 0, 200),
        ("act", 1000, 0, 225),
    ):
        for task in ("LiftBox", "GraspCube"):
            cell = dataclasses.replace(CELL, task=task, policy=policy, num_train_episodes=size, train_seed=seed)
            found.append(make_line(cell, successes))
    return found


def test_tables_have_the_papers_numbers_beside_ours(tmp_path: Path) -> None:
    lines = [make_line(successes=1), make_line(dataclasses.replace(CELL, train_seed=7), stamp="old"), *lines_of_all()]
    rows = tables.main_table(lines).splitlines()
    assert rows[2] == "| task | 100: MLP | paper 100 | 1000: MLP | 1000: ACT | paper 1000 | paper 5000 |"
    lift = next(row for row in rows if row.startswith("| LiftBox"))
    assert "44.0 (" in lift and ", 2 seeds | 86.4 | 80.0 (74.6 to 84.5) | 90.0 (85.7 to 93.1) | 98.6 | 98.8 |" in lift
    assert not any("earlier" in row for row in rows)
    assert "| PressCube, an earlier version |" in tables.main_table(
        [make_line(dataclasses.replace(CELL, task="PressCube"), stamp="old")]
    )
    table = tables.architectures_table(lines)
    assert "| GraspCube | 1000 | cpu | 80.0 (74.6 to 84.5) | 90.0 (85.7 to 93.1) | - | 81.3 | 87.9 | 90.2 |" in table
    assert tables.architectures_table(lines[:3]) == ""
    for region, successes, made_by in (("R3", 1, "old"), ("R1", 99, ""), ("R2", 98, ""), ("R3", 97, "")):
        facts = {"task": "Handover", "region": region, "attempts": 100, "successes": successes, "outcomes": {}}
        facts["stamp"] = made_by or stamp("Handover")
        lines.append(tmp_path / "generation.jsonl", "demohlm reproduce --table regions", facts)
    bars = ET.fromstring(plots.regions_figure(lines.read(tmp_path / "generation.jsonl")))
    assert len([element for element in bars.iter() if element.tag.endswith("circle")]) == 3 + 3  # ours and the paper's
    for line in lines:
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce --table main", line)
    text = readme_tables.tables(tmp_path)
    assert "| Handover | 99.0 (94.6 to 99.8) | 98.0 (93.0 to 99.4) | 97.0 (91.5 to 99.0) |" in text
    aged = [{**line, "stamp": "old"} for line in lines.read(tmp_path / "generation.jsonl")]
    assert "| Handover, an earlier version |" in tables.regions_table(aged)
    assert "Handover, an earlier version" in plots.regions_figure(aged)
    assert tables.regions_table([*aged, facts]) == "", "one region is of this version, the others are not"
    assert text.count("demohlm reproduce --table main") == 1
    assert "| MLP, cpu | 6 | 10.0 min | 5000 | 2000 |" in text


def test_an_ablation_of_data_stands_beside_the_papers_tables(tmp_path: Path) -> None:
    cells = plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0], policies=["mlp"], variants=["plain", "noise"])
    assert cells == [dataclasses.replace(CELL, variant="plain"), CELL]
    plain, noise = dataclasses.replace(CELL, variant="plain"), CELL
    own = layout(tmp_path)
    assert own.training(plain) != own.training(noise)
    own.dataset("LiftBox", "R3", 1000, "noise").mkdir(parents=True)
    assert own.dataset("LiftBox", "R3", 100, "noise").name.endswith("_1000")
    assert own.dataset("LiftBox", "R3", 100).name.endswith("_100")
    old = make_line(plain, 200)
    assert plain.is_of(old) and not noise.is_of(old)
    new = make_line(noise, 225, data_success_rate=0.97)
    rows = tables.variants_table([old, new]).splitlines()
    assert rows[2] == "| task | region | policy | episodes | plain | noise | generation: plain | generation: noise |"
    assert rows[4] == "| LiftBox | R3 | MLP | 100 | 80.0 (74.6 to 84.5) | 90.0 (85.7 to 93.1) | - | 97.0 |"
    assert tables.variants_table([old, old]) == ""
    assert tables.main_table([old, new]) == tables.main_table([new])
    assert tables.main_table([old]) == tables.variants_table([new]) == ""
    assert plots.size_figure([old, new]) == plots.size_figure([new])
    assert tables.variants_table([old, new]) in tables.experiments_tables([old, new])
    with pytest.raises(UnknownNameError, match="variant 'noisy'"):
        dataclasses.replace(CELL, variant="noisy")


def test_paper_has_every_task() -> None:
    assert paper.SUCCESS_BY_SIZE.keys() == paper.SUCCESS_BY_ARCHITECTURE.keys()
    assert {task for task, region in paper.GENERATION if region == "R3"} == paper.SUCCESS_BY_SIZE.keys()
    assert paper.SUCCESS_BY_SIZE.keys() <= all_tasks().keys()
    for task, rates in paper.SUCCESS_BY_SIZE.items():
        assert list(rates) == sorted(rates), task  # the paper's claim
        assert rates[-1] == paper.SUCCESS_BY_ARCHITECTURE[task]["act"]
    assert paper.success("LiftBox", 1000) == 98.6
    assert paper.success("LiftBox", 1001) is None
    assert [tables.number(value) for value in (13.35, 89.25, 86.41, 100.0, None)] == [
        "13.4",
        "89.3",
        "86.4",
        "100.0",
        "-",
    ]


def test_figures_are_svg_with_a_point_a_number() -> None:
    lines = lines_of_all()
    drawn = ET.fromstring(plots.size_figure(lines))
    circles = [element for element in drawn.iter() if element.tag.endswith("circle")]
    assert len(circles) == 3 * (5 + 2 + 1)  # two tasks and their mean: the paper, MLP at two sizes, ACT at one
    floor, top = plots.HEIGHT - plots.BOTTOM, plots.TOP
    heights = sorted({round((floor - float(circle.get("cy", 0))) / (floor - top), 2) for circle in circles})
    assert {0.44, 0.8, 0.9} <= set(heights)  # of lines_of_all; 0.44 is the mean of two seeds
    whiskers = [
        round((float(line.get("y2", 0)) - float(line.get("y1", 0))) / (floor - top), 2)
        for line in drawn.iter()
        if line.tag.endswith("line") and line.get("x1") == line.get("x2")
    ]
    low, high = tables.wilson(200, 250)
    assert round(high - low, 2) in whiskers
    _, low, high = tables.mean_rate([[make_line(successes=200)]] * 2)
    assert round(high - low, 2) in whiskers
    bars = ET.fromstring(plots.architectures_figure(lines))
    assert len([element for element in bars.iter() if element.get("width") == "16"]) == 2 * (3 + 2)
    sizes = {round(float(bar.get("height", 0)) / (floor - top), 2) for bar in bars.iter() if bar.get("width") == "16"}
    assert {0.8, 0.9} <= sizes
    larger = [make_line(dataclasses.replace(CELL, num_train_episodes=5000, policy=name)) for name in ("mlp", "act")]
    third = make_line(dataclasses.replace(CELL, num_train_episodes=1000, policy="diffusion"))
    assert "LiftBox, 5000 episodes" in plots.architectures_figure([*lines, *larger])
    assert "LiftBox, 1000 episodes" in plots.architectures_figure([*lines, *larger, third]), "all three are compared"
    assert plots.size_figure(lines, "paper") == plots.regions_figure([]) == ""


def test_failure_map_counts_where_they_began() -> None:
    starts = [(-1.0, 0.0), (-1.0, 0.0), (-0.2, 0.1), (-0.2, -0.1)]
    records = [
        {"initial_state": {"robot": [x, y, 0.0]}, "success_held": place != 1} for place, (x, y) in enumerate(starts)
    ]
    drawn = ET.fromstring(plots.failure_map(records, bins=4))
    titles = [element.text for element in drawn.iter() if element.tag.endswith("title")]
    assert titles.count("1 of 2 failed") == 1
    assert sum(int((title or "").split()[2]) for title in titles) == 4
    assert [element.text for element in drawn.iter() if element.text == "1/2"] == ["1/2"]


def test_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = layout(tmp_path)
    for line in lines_of_all():
        lines.append(own.policies_file, "demohlm reproduce --table main", line)
    outcomes = ["success", "fell", "fell", "dropped"]
    records = [
        {
            "seed": seed,
            "outcome": outcome,
            "success_held": outcome == "success",
            "initial_state": {"robot": [-0.3 * seed, 0.1, 0.0]},
        }
        for seed, outcome in enumerate(outcomes)
    ]
    checkpoint(own.training(CELL)).mkdir(parents=True)
    own.rollouts(CELL).parent.mkdir(parents=True)
    own.rollouts(CELL).write_text("".join(json.dumps(record) + "\n" for record in records))
    filmed: list[int] = []
    monkeypatch.setattr(
        page, "_films", lambda cell, layout, record: (filmed.append(record["seed"]), [("AA", "a <fall>")])[1]
    )
    words = ["report", "--results", str(own.results), "--experiments", str(own.root), "--num-videos", "2"]
    assert cli.main([*words, "--output", str(tmp_path / "page.html"), "--figures", str(tmp_path / "figures")]) == 0
    assert filmed == [1, 3]  # one of each outcome
    text = (tmp_path / "page.html").read_text()
    assert text.count("a &lt;fall&gt;") == 2
    assert "<td>LiftBox</td>" in text
    assert "LiftBox: MLP, 100 episodes, seed 0" in text
    assert text.count("<h3>") == 1
    names = sorted(file.name for file in (tmp_path / "figures").iterdir())
    assert names == ["architectures_cpu.svg", "sizes_cpu.svg"]
    assert cli.main(["report", "--results", str(tmp_path / "no"), "--output", str(tmp_path / "other.html")]) == 2


def test_films_are_of_the_failure_that_was_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = gallery.Take(task=get_task("LiftBox"), snapshots=[], origin="mlp", outcome="dropped", length_s=3.0)
    monkeypatch.setattr(gallery, "policy_take", lambda *_: take)

    def write(_take: gallery.Take, root: Path, width: int) -> None:
        (root / "lift_box_overview.mp4").write_bytes(b"film")

    monkeypatch.setattr(gallery, "write_take", write)
    assert page._films(CELL, layout(tmp_path), {"seed": 3, "outcome": "fell"}) == []
    ((film, caption),) = page._films(CELL, layout(tmp_path), {"seed": 3, "outcome": "dropped"})
    assert film == "ZmlsbQ==" and "mlp" in caption
