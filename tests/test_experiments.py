"""Experiments: the order of the cells, running and resuming them, tables and figures from their lines."""

import dataclasses
import importlib
import json
import os
import time
import xml.etree.ElementTree as ET
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import make_episode, make_facts

from gym_demohlm.errors import DatasetError, PolicyError, UnknownNameError
from gym_demohlm.task import all_tasks, get_task
from lerobot_demohlm import cli, gallery, provenance, results
from lerobot_demohlm.dataset import write_facts
from lerobot_demohlm.experiments import page, paper, plots, tables
from lerobot_demohlm.experiments.cells import Effort, run_cell
from lerobot_demohlm.experiments.cells import _alone as run_alone
from lerobot_demohlm.experiments.plan import DEFAULT_VARIANT, Cell, Layout, RegionCell, plan, stamp
from lerobot_demohlm.experiments.reproduce import missing, reproduce
from lerobot_demohlm.training import checkpoint

CELL = Cell(task="LiftBox", policy="mlp", preset="cpu", num_train_episodes=100, train_seed=0, steps=8000)


def make_line(cell: Cell = CELL, successes: int = 200, **changes: Any) -> dict[str, Any]:
    """Return the line of a cell with 250 rollouts."""
    counts = {"episodes": 250, "successes": successes, "successes_end": successes, "successes_ever": successes}
    outcomes = {"success": successes, "fell": 250 - successes}
    times = {"train_s": 600.0, "train_samples_per_s": 5000, "rollouts_per_hour": 2000}
    own = {"stamp": stamp(cell.task), "recipe": cell.recipe, "policy_hash": "0" * 64, "outcomes": outcomes}
    return dataclasses.asdict(cell) | own | counts | times | changes


def fake_run(cell: Cell | RegionCell) -> dict[str, Any] | None:
    """Stand in for what runs a cell, in another process."""
    if cell.task == "PushCube":
        raise DatasetError("no success", "some", "try again")
    if cell.task == "Handover":
        raise ValueError("torch has something against it")
    if cell.task == "GraspCube":
        os._exit(9)  # as one that is killed for its memory
    return None if cell.task == "PressCube" or not isinstance(cell, Cell) else make_line(cell)


def layout(root: Path) -> Layout:
    return Layout(root=root / "runs", results=root / "results")


def test_every_task_has_a_number_before_any_has_two() -> None:
    cells = plan("main")
    tasks = list(all_tasks())
    for start in range(0, len(cells), len(tasks)):
        assert [cell.task for cell in cells[start : start + len(tasks)]] == tasks
    assert len(set(cells)) == len(cells) == 5 * len(tasks)
    rounds = [
        (c.policy, c.num_train_episodes, c.train_seed) for c in cells if isinstance(c, Cell) and c.task == tasks[0]
    ]
    assert rounds == [("mlp", 1000, 0), ("mlp", 100, 0), ("act", 1000, 0), ("mlp", 1000, 1), ("mlp", 100, 1)]
    assert {cell.policy for cell in plan("architectures", tasks=["LiftBox"])} == {"mlp", "act", "diffusion"}  # pyright: ignore
    assert {cell.region for cell in plan("regions")} == {"R1", "R2", "R3"}
    assert len(plan("main", tasks=["LiftBox"], sizes=[5000], seeds=[3], policies=["mlp"])) == 1
    with pytest.raises(UnknownNameError, match="task 'Lift'"):
        plan("main", tasks=["Lift"])
    with pytest.raises(PolicyError, match="num_train_episodes=0"):
        plan("main", sizes=[0])


def test_smaller_sizes_come_from_the_larger_dataset(tmp_path: Path) -> None:
    own = layout(tmp_path)
    first = own.dataset("LiftBox", "R3", 1000)
    first.mkdir(parents=True)
    assert own.dataset("LiftBox", "R3", 100) == own.dataset("LiftBox", "R3", 1000) == first
    assert own.dataset("LiftBox", "R3", 1001) != first
    assert own.dataset("LiftBox", "R2", 100) != first
    own.dataset("LiftBox", "R3", 5000).mkdir()
    assert own.dataset("LiftBox", "R3", 100) == first


def test_a_region_counts_the_first_attempts_of_a_dataset_to_train_on(tmp_path: Path) -> None:
    own, cell = layout(tmp_path), RegionCell(task="LiftBox", region="R3")
    root = own.dataset(cell.task, cell.region, 2)
    outcomes = ["success", "fell", "success", "success"]
    (root / "meta").mkdir(parents=True)
    write_facts(root, make_facts(), [make_episode(i, outcome=outcome).record() for i, outcome in enumerate(outcomes)])
    line = run_cell(cell, own, Effort(num_attempts=3, deadline=0.0))
    assert line is not None and cell.is_of(line)
    assert (line["attempts"], line["successes"], line["outcomes"]["fell"]) == (3, 2, 1)
    assert line["episode_s"] == pytest.approx(1.2)
    assert run_cell(cell, own, Effort(num_attempts=5, deadline=0.0)) is None, "there are not so many, and no time"


def test_a_region_whose_line_was_never_written_is_not_made_again(tmp_path: Path) -> None:
    own, cell = layout(tmp_path), RegionCell(task="LiftBox", region="R2")
    root = own.generation(cell, 2)
    (root / "meta").mkdir(parents=True)
    write_facts(root, make_facts(), [make_episode(i).record() for i in range(2)])
    line = run_cell(cell, own, Effort(num_attempts=2, deadline=0.0))
    assert line is not None and line["attempts"] == 2


def test_what_is_missing_is_run_and_the_rest_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = layout(tmp_path)
    tasks = ["LiftBox", "PressCube", "PushCube"]
    cells = plan("main", tasks=[*tasks, "Handover", "GraspCube"], sizes=[100], seeds=[0], policies=["mlp"])
    cells += plan("main", tasks=tasks, sizes=[100], seeds=[1], policies=["mlp"])
    done, failures = reproduce(cells, own, fake_run, num_workers=2, command="demohlm reproduce ...")
    assert done == 2
    assert sorted(failure.partition("_mlp")[0] for failure in failures) == [
        "grasp_cube",
        "handover",
        "push_cube",
        "push_cube",
    ]
    texts = "\n".join(failures)
    assert "no success" in texts and "ValueError: torch has something" in texts and "BrokenProcessPool" in texts
    cells = plan("main", tasks=tasks, sizes=[100], seeds=[0, 1], policies=["mlp"])
    lines = results.read(own.policies_file)
    assert sorted(line["train_seed"] for line in lines) == [0, 1]
    assert {(line["task"], line["command"]) for line in lines} == {("LiftBox", "demohlm reproduce ...")}
    assert [cell.task for cell in missing(cells, own)] == ["PressCube", "PushCube"] * 2
    assert reproduce(cells[:1], own, fake_run) == (0, [])
    assert reproduce(missing(cells, own), own, fake_run, deadline=time.monotonic()) == (0, [])
    results.append(own.policies_file, "another robot", make_line(CELL, stamp="other"))
    assert CELL not in missing([CELL], own)
    assert missing([CELL], own, num_rollouts=251) == [CELL]
    capsys.readouterr()
    words = ["reproduce", "--table", "main", "--tasks", *tasks, "--sizes", "100", "--policies", "mlp", "--seeds", "0"]
    folders = ["--root", str(own.root), "--results", str(own.results)]
    assert cli.main([*words, *folders, "--dry-run"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert cli.main([*words, *folders, "--budget-hours", "0"]) == 2
    assert cli.main([*words, *folders, "--budget-hours", "1e-9"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["missing"] == 2


@pytest.mark.parametrize(
    "changes",
    [{"stamp": "other"}, {"recipe": "other"}, {"steps": 2}, {"variant": "plain"}, {"train_seed": 1}, {"episodes": 2}],
    ids=str,
)
def test_a_line_of_something_else_is_not_a_cells(tmp_path: Path, changes: dict[str, Any]) -> None:
    own = layout(tmp_path)
    results.append(own.policies_file, "demohlm reproduce", make_line(CELL, **changes))
    assert missing([CELL], own, num_rollouts=250) == [CELL]
    results.append(own.policies_file, "demohlm reproduce", make_line(CELL))
    assert missing([CELL], own, num_rollouts=250) == []


def test_regions_are_of_plain_attempts_and_enough_of_them(tmp_path: Path) -> None:
    own, cell = layout(tmp_path), RegionCell(task="LiftBox", region="R3")
    line = {"task": "LiftBox", "region": "R3", "stamp": stamp("LiftBox"), "attempts": 500, "successes": 500}
    for changes in ({"command_noise": 1.0}, {"start_spread": 1.3}, {"retries": 1}, {"stamp": "other"}, {"attempts": 3}):
        results.append(own.generation_file, "demohlm generate", {**line, **changes})
    assert missing([cell], own, num_attempts=500) == [cell]
    results.append(own.generation_file, "demohlm generate", line)
    assert missing([cell], own, num_attempts=500) == []


def test_a_stamp_is_of_what_a_tasks_module_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = '"""A task."""\n\ndef build():\n    """Build it."""\n    return 1  # %s\n'
    hashes = []
    for name, content in (("one", text % "a"), ("two", text % "b"), ("three", text.replace("1", "2"))):
        (tmp_path / f"task_{name}.py").write_text(content)
        monkeypatch.syspath_prepend(tmp_path)
        module = importlib.import_module(f"task_{name}")
        hashes.append(provenance.task_hash(dataclasses.replace(get_task("LiftBox"), build=module.build)))
    assert hashes[0] == hashes[1] != hashes[2], "comments are no change, numbers are"
    before = stamp("LiftBox")
    stamp.cache_clear()
    monkeypatch.setattr(provenance, "task_hash", lambda _: "another")
    assert stamp("LiftBox") != before
    stamp.cache_clear()


def test_a_training_has_a_place_of_its_own_by_its_steps(tmp_path: Path) -> None:
    own, trial = layout(tmp_path), dataclasses.replace(CELL, steps=2)
    assert own.training(trial) != own.training(CELL)
    assert own.rollouts(trial) != own.rollouts(CELL)
    assert plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0], policies=["mlp"], steps=2) == [trial]
    assert plan("main", tasks=["LiftBox"] * 2, sizes=[100] * 2, seeds=[0, 0], policies=["mlp"]) == [CELL]


def test_two_at_one_cell_are_told_so(tmp_path: Path) -> None:
    own = layout(tmp_path)
    own.training(CELL).parent.mkdir(parents=True)
    with run_alone(own.training(CELL)), pytest.raises(DatasetError, match="is at work"):
        run_cell(CELL, own, Effort(deadline=0.0))
    assert run_cell(CELL, own, Effort(deadline=0.0)) is None, "the time is up, and nobody holds it"


def process_of(cell: Cell) -> dict[str, Any]:
    """Stand in for what runs a cell."""
    return make_line(cell, process=os.getpid())


def test_each_cell_has_a_process_of_its_own(tmp_path: Path) -> None:
    own, run = layout(tmp_path), process_of
    wanted = plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0, 1, 2], policies=["mlp"])
    assert reproduce(wanted, own, run) == (3, [])  # pyright: ignore[reportArgumentType]
    assert len({line["process"] for line in results.read(own.policies_file)} | {os.getpid()}) == 4


def run_beside(cell: Cell, folder: Path, seconds: float) -> dict[str, Any]:
    """Stand in for what runs a cell, and wait so long for another beside it."""
    (folder / f"seed{cell.train_seed}").touch()
    end = time.monotonic() + seconds
    while (began := len(list(folder.glob("seed*")))) < 2 and time.monotonic() < end:
        time.sleep(0.01)
    return make_line(cell, began=began)


@pytest.mark.parametrize("made", [False, True])
def test_one_cell_makes_the_data_of_both(tmp_path: Path, made: bool) -> None:
    own, cells = layout(tmp_path), plan("main", tasks=["LiftBox"], sizes=[100], seeds=[0, 1], policies=["mlp"])
    if made:
        own.dataset("LiftBox", "R3", 1000, DEFAULT_VARIANT).mkdir(parents=True)
    run: Any = partial(run_beside, folder=tmp_path, seconds=60.0 if made else 2.0)
    assert reproduce(cells, own, run, num_workers=2) == (2, [])
    assert [line["began"] for line in results.read(own.policies_file)] == [2 if made else 1, 2]


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
        results.append(tmp_path / "generation.jsonl", "demohlm reproduce --table regions", facts)
    bars = ET.fromstring(plots.regions_figure(results.read(tmp_path / "generation.jsonl")))
    assert len([element for element in bars.iter() if element.tag.endswith("circle")]) == 3 + 3  # ours and the paper's
    for line in lines:
        results.append(tmp_path / "experiments.jsonl", "demohlm reproduce --table main", line)
    text = results.tables(tmp_path)
    assert "| Handover | 99.0 (94.6 to 99.8) | 98.0 (93.0 to 99.4) | 97.0 (91.5 to 99.0) |" in text
    aged = [{**line, "stamp": "old"} for line in results.read(tmp_path / "generation.jsonl")]
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
        results.append(own.policies_file, "demohlm reproduce --table main", line)
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


@pytest.mark.slow
def test_a_table_from_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["reproduce", "--table", "main", "--tasks", "LiftBox", "--sizes", "2", "1", "--seeds", "0", "--steps", "2"]
    words += ["--policies", "mlp", "--num-rollouts", "2", "--root", str(tmp_path / "runs")]
    words += ["--results", str(tmp_path / "results")]
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["run"] == 2
    lines = results.read(tmp_path / "results/experiments.jsonl")
    assert [line["num_train_episodes"] for line in lines] == [2, 1]
    assert [line["episodes"] for line in lines] == [2, 2]
    assert len(list((tmp_path / "runs/data").iterdir())) == 1
    assert np.isfinite([line["train_samples_per_s"] for line in lines]).all()
    assert cli.main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {
        "table": "main",
        "run": 0,
        "missing": 0,
        "failed": [],
    }
    assert results.read(tmp_path / "results/experiments.jsonl") == lines
