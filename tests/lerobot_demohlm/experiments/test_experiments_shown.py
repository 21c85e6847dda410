"""What is made of the lines of experiments: rates, tables, figures, a page."""

import dataclasses
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gym_demohlm import jsonl
from gym_demohlm.errors import UnknownNameError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.variation import get_variation
from lerobot_demohlm import cli, drawing
from lerobot_demohlm.evaluation.evaluate import wilson
from lerobot_demohlm.evaluation.rollout import Rollout
from lerobot_demohlm.experiments import lines, paper, plots, rates, readme_tables, robustness, tables
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import STRENGTHS, graded, plan
from lerobot_demohlm.experiments.robustness import Row
from lerobot_demohlm.experiments.variants import stamp
from lerobot_demohlm.policies.presets import get_preset
from lerobot_demohlm.policies.training import checkpoint
from lerobot_demohlm.reports import experiments_page as page
from lerobot_demohlm.reports import films
from tests.helpers.experiment_lines import CELL, layout, make_line


def test_rates() -> None:
    one = make_line(successes=200)
    assert rates.rate([one]) == (0.8, *wilson(200, 250))
    mean, low, high = rates.rate([one, make_line(successes=250)])
    assert mean == 0.9
    assert 0.77 < low < 0.82  # two trainings that differ: the interval spans them
    assert 0.99 < high <= 1.0
    assert rates.rate([one, one]) == pytest.approx(rates.rate([one]), abs=0.03)
    mean, low, high = rates.rate([make_line(successes=0)] * 3)
    assert mean == low == 0.0
    assert 0.001 < high < 0.01
    mean, low, high = rates.mean_rate([[make_line(successes=200)]] * 10)
    assert mean == 0.8
    assert (low, high) == pytest.approx(wilson(2000, 2500), abs=0.003)  # narrower than one task's


def lines_of_all() -> list[PolicyResult]:
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
    own = [make_line(successes=1), make_line(dataclasses.replace(CELL, train_seed=7), stamp="old"), *lines_of_all()]
    rows = tables.main_table(own).splitlines()
    assert rows[2] == "| task | 100: MLP | paper 100 | 1000: MLP | 1000: ACT | paper 1000 | paper 5000 |"
    lift = next(row for row in rows if row.startswith("| LiftBox"))
    assert "44.0 (" in lift and ", 2 seeds | 86.4 | 80.0 (74.6 to 84.5) | 90.0 (85.7 to 93.1) | 98.6 | 98.8 |" in lift
    assert not any("earlier" in row for row in rows)
    assert "| PressCube, an earlier version |" in tables.main_table(
        [make_line(dataclasses.replace(CELL, task="PressCube"), stamp="old")]
    )
    table = tables.architectures_table(own)
    assert "| GraspCube | 1000 | cpu | 80.0 (74.6 to 84.5) | 90.0 (85.7 to 93.1) | - | 81.3 | 87.9 | 90.2 |" in table
    assert tables.architectures_table(own[:3]) == ""
    for region, successes, made_by in (("R3", 1, "old"), ("R1", 99, ""), ("R2", 98, ""), ("R3", 97, "")):
        made = made_by or stamp("Handover")
        found = GenerationResult(task="Handover", region=region, attempts=100, successes=successes, stamp=made)
        lines.append(tmp_path / "generation.jsonl", "demohlm reproduce --table regions", found)
    drawn = plots.regions_figure(lines.read_generation(tmp_path / "generation.jsonl"))
    assert drawn is not None and len(points(drawn)) == 3 + 3  # ours and the paper's
    for line in own:
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce --table main", line)
    text = readme_tables.tables(tmp_path)
    assert "| Handover | 99.0 (94.6 to 99.8) | 98.0 (93.0 to 99.4) | 97.0 (91.5 to 99.0) |" in text
    generated = lines.read_generation(tmp_path / "generation.jsonl")
    aged = [dataclasses.replace(line, stamp="old") for line in generated]
    assert "| Handover, an earlier version |" in tables.regions_table(aged)
    drawn = plots.regions_figure(aged)
    assert drawn is not None and drawn.axes[0].get_title("left") == "Handover\nan earlier version"
    row = tables.regions_table([*aged, generated[-1]]).splitlines()[-1]
    assert row.startswith("| Handover | ") and row.count("earlier") == 2, "one region is of this version, two are not"
    assert text.count("demohlm reproduce --table main") == 1
    assert "| MLP, cpu | 6 | 10.0 min | 5000 | 2000 |" in text


def test_a_training_counts_once_and_a_table_of_policies_is_of_one_region() -> None:
    varied = dataclasses.replace(CELL, variant="real", num_train_episodes=1000)
    worlds = [dataclasses.replace(varied, variation=name) for name in ("none", "real", "hard")]
    again = dataclasses.replace(varied, train_seed=1)
    assert "| MLP, cpu | 2 |" in tables.cost_table(map(make_line, [*worlds, again]))
    narrow = [make_line(dataclasses.replace(CELL, policy=policy), 250) for policy in ("mlp", "act")]
    wide = [make_line(dataclasses.replace(CELL, policy=policy, region="R4"), 100) for policy in ("mlp", "act")]
    row = "| LiftBox | 100 | cpu | 100.0 (98.5 to 100.0) | 100.0 (98.5 to 100.0) | - |"
    assert row in tables.experiments_tables([*narrow, *wide])


def test_the_mean_of_robustness_is_of_the_policies_that_are_measured_at_all_strengths() -> None:
    strong = {
        graded("pushes", strength): (successes, 50) for strength, successes in zip(STRENGTHS, (40, 30, 20), strict=True)
    }
    weak = {
        graded("pushes", strength): (successes, 50) for strength, successes in zip(STRENGTHS, (30, 20, 0), strict=True)
    }
    rows = [
        Row(name="LiftBox", shares={"none": (50, 50), **strong}),
        Row(name="Handover", shares={"none": (40, 50), **weak}),
        Row(name="PushCube", shares={"none": (50, 50), graded("pushes", 1.0): (1, 50)}),
    ]
    drawn = plots.robustness_figure(rows)
    assert drawn is not None and [axes.get_title("left") for axes in drawn.axes] == ["pushes"]
    assert [(axes.get_xlabel(), axes.get_ylabel()) for axes in drawn.axes] == [("strength of hard", "success [%]")]
    np.testing.assert_allclose(points(drawn), [100, 80, 60, 40, 80, 60, 40, 0, 90, 70, 50, 20])
    assert plots.robustness_figure(rows[2:]) is None
    aged = plots.robustness_figure([dataclasses.replace(rows[0], age=rates.EARLIER), *rows[1:]])
    assert aged is not None and aged.axes[0].get_title("left") == "pushes\nin part an earlier version"


def points(figure: Figure) -> list[float]:
    """Return the heights [%] of all points of a figure."""
    dots = [dot for axes in figure.axes for dot in axes.lines if dot.get_marker() == "o"]
    return [float(np.asarray(dot.get_ydata())[0]) for dot in dots]


def whiskers(figure: Figure) -> list[float]:
    """Return the lengths [%] of all intervals of a figure."""
    found = [part for axes in figure.axes for part in axes.collections if isinstance(part, LineCollection)]
    segments = [np.asarray(segment) for part in found for segment in part.get_segments()]
    return [round(float(segment[1, 1] - segment[0, 1]), 2) for segment in segments]


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
    both, one = plots.size_figure([old, new]), plots.size_figure([new])
    assert both is not None and one is not None and drawing.svg(both) == drawing.svg(one)
    assert tables.variants_table([old, new]) in tables.experiments_tables([old, new])
    with pytest.raises(UnknownNameError, match="variant 'noisy'"):
        dataclasses.replace(CELL, variant="noisy")


def test_harder_worlds_stand_beside_the_papers_tables(tmp_path: Path) -> None:
    real = dataclasses.replace(CELL, variant="real", variation="real")
    own = [
        make_line(successes=250),
        make_line(dataclasses.replace(CELL, variation="real"), 200, successes_strict=150),
        make_line(real, 225, successes_strict=220),
        make_line(dataclasses.replace(real, region="R4"), 125, successes_strict=100),
        make_line(dataclasses.replace(CELL, perception="rgbd"), 245, successes_strict=240),
        make_line(dataclasses.replace(CELL, task="PressCube"), 250),
    ]
    rows = tables.worlds_table(own).splitlines()
    assert rows[2] == "| task | policy | episodes | data | R3, `none` | R3, `real` | R4, `real` |"
    assert rows[4:] == [
        "| LiftBox | MLP | 100 | noise | 100.0 (98.5 to 100.0) | 80.0 (74.6 to 84.5), strict 60.0 | - |",
        "| LiftBox | MLP | 100 | real | - | 90.0 (85.7 to 93.1), strict 88.0 | 50.0 (43.8 to 56.2), strict 40.0 |",
    ]
    rows = tables.perception_table(own).splitlines()
    assert rows[2] == "| task | region | policy | episodes | data | `exact` | `rgbd` |"
    assert rows[4:] == [
        "| LiftBox | R3 | MLP | 100 | noise | 100.0 (98.5 to 100.0) | 98.0 (95.4 to 99.1), strict 96.0 |"
    ]
    plain = [own[0], own[-1]]
    assert tables.worlds_table(plain) == tables.perception_table(plain) == ""
    assert tables.main_table(own) == tables.main_table(plain)
    both, one = plots.size_figure(own), plots.size_figure(plain)
    assert both is not None and one is not None and drawing.svg(both) == drawing.svg(one)
    for line in own:
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce --table worlds", line)
    text = readme_tables.tables(tmp_path)
    assert tables.worlds_table(own) in text and tables.perception_table(own) in text
    assert "vary by one group" not in text


def test_trainings_of_other_steps_have_rows_of_their_own_or_stand_in() -> None:
    real = dataclasses.replace(CELL, variant="real", variation="real")
    usual, longer = make_line(real, 100), make_line(dataclasses.replace(real, steps=24000), 200)
    rows = tables.worlds_table([usual, longer]).splitlines()
    assert rows[4].startswith("| LiftBox | MLP | 100 | real | 40.0 ")
    assert rows[5].startswith("| LiftBox | MLP, 24000 steps | 100 | real | 80.0 ")
    assert rates.latest([usual, longer]) == rates.latest([longer, usual]) == [usual]
    assert rates.latest([longer]) == [longer]
    before = make_line(real, 90, stamp="before")
    assert rates.latest([before, longer]) == [before]  # a longer training does not pass for the usual one
    assert rates.latest([usual, longer], any_steps=True) == [usual, longer]


def test_each_cell_says_of_which_version_it_is() -> None:
    old = [
        make_line(dataclasses.replace(CELL, policy=policy, train_seed=seed), 200, stamp="before")
        for policy in ("mlp", "act")
        for seed in (0, 1)
    ]
    rows = tables.main_table(old).splitlines()
    assert rows[4].startswith("| LiftBox, an earlier version | 80.0 ") and rows[4].count("earlier") == 1
    mixed = [*old, make_line(successes=250)]
    assert len(rates.latest(mixed)) == 3, "a cell is of one version, its last line's"
    for row in (tables.main_table(mixed).splitlines()[4], tables.architectures_table(mixed).splitlines()[4]):
        assert row.startswith("| LiftBox | ") and " 100.0 (98.5 to 100.0) | 80.0 (" in row
        assert row.count("2 seeds, an earlier version |") == row.count("earlier") == 1
    drawn = [plots.size_figure(shown) for shown in (old, mixed, mixed[-1:])]
    titles = [figure.axes[0].get_title("left") for figure in drawn if figure]
    assert titles == ["LiftBox\nan earlier version", "LiftBox\nin part an earlier version", "LiftBox"]


def test_scores_under_each_group_become_rows(tmp_path: Path) -> None:
    cell = dataclasses.replace(CELL, policy="act", variant="real")
    names = ["none", "hard@0.5:objects", "hard@1.5:objects", "real"]
    own = [
        make_line(dataclasses.replace(cell, variation=name, train_seed=seed), 250, successes_strict=250 - 50 * index)
        for index, name in enumerate(names)
        for seed in (0, 1)
    ]
    paper_like = dataclasses.replace(cell, preset="paper", variation="hard@1:robot")
    other = make_line(paper_like, successes_strict=9, steps=get_preset("act", "paper").steps)
    longer = make_line(dataclasses.replace(cell, variation="hard@1:robot"), successes_strict=9, steps=24_000)
    assert [row.name for row in robustness.scored([*own, other, longer])] == [
        "LiftBox R3, ACT (paper) of 100 real", "LiftBox R3, ACT of 100 real", "LiftBox R3, ACT of 100 real, 24000 steps"
    ], "another recipe is another row, and so is another number of steps"  # fmt: skip
    rows = robustness.scored([*own, make_line(CELL, successes_strict=9)])
    assert [row.name for row in rows] == ["LiftBox R3, ACT of 100 real"]
    assert rows[0].shares["none"] == (500, 500)
    assert "| LiftBox R3, ACT of 100 real | 100 | 80 / - / 60 | - / - / - |" in robustness.table(rows)
    points = rows[0].points("objects")
    assert [point[:2] for point in points] == [(0.0, 1.0), (0.5, 0.8), (1.5, 0.6)]
    assert robustness.scored(own[:2]) == [] and robustness.table([]) == ""
    for line in own:
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce --table robustness", line)
    assert robustness.table(rows) in readme_tables.tables(tmp_path)


def test_regions_of_varied_worlds_have_a_table_of_their_own() -> None:
    found = [
        GenerationResult(
            task="Handover",
            region=region,
            attempts=100,
            successes=successes,
            variation=variation,
            stamp=stamp("Handover", variation, region=region),
        )
        for variation, region, successes in (
            ("none", "R1", 99), ("none", "R2", 98), ("none", "R3", 97), ("none", "R4", 90), ("real", "R3", 80)
        )
    ]  # fmt: skip
    rows = tables.regions_table(found).splitlines()
    assert rows[2] == "| task | R1 | R2 | R3 | R4 | paper: R1 | paper: R2 | paper: R3 |"
    assert "| 90.0 (82.6 to 94.5) |" in rows[4]
    assert rows[6].startswith("**Generation success by initial region in worlds that vary by `real`**")
    assert rows[8:] == ["| task | R3 |", "|---|---|", "| Handover | 80.0 (71.1 to 86.7) |"]
    wide = dataclasses.replace(found[-1], region="R4", successes=70, stamp=stamp("Handover", "real", region="R4"))
    rows = tables.regions_table([*found, wide]).splitlines()
    assert rows[-1] == "| Handover | 80.0 (71.1 to 86.7) | 70.0 (60.4 to 78.1) |", "R4 has a version of its own"
    old = dataclasses.replace(wide, stamp=stamp("Handover", "real"))
    assert tables.regions_table([*found, old]).splitlines()[-1].endswith("70.0 (60.4 to 78.1), an earlier version |")
    assert tables.regions_table(found[1:4]) == "", "not all regions of the paper"
    drawn = plots.regions_figure(found)
    assert drawn is not None and len(points(drawn)) == 3 + 3


def test_paper_has_every_task() -> None:
    assert paper.SUCCESS_BY_SIZE.keys() == paper.SUCCESS_BY_ARCHITECTURE.keys()
    assert {task for task, region in paper.GENERATION if region == "R3"} == paper.SUCCESS_BY_SIZE.keys()
    assert paper.SUCCESS_BY_SIZE.keys() <= all_tasks().keys()
    for task, shares in paper.SUCCESS_BY_SIZE.items():
        assert list(shares) == sorted(shares), task  # the paper's claim
        assert shares[-1] == paper.SUCCESS_BY_ARCHITECTURE[task]["act"]
    assert paper.success("LiftBox", 1000) == 98.6
    assert paper.success("LiftBox", 1001) is None
    assert [rates.number(value) for value in (13.35, 89.25, 86.41, 100.0, None)] == [
        "13.4",
        "89.3",
        "86.4",
        "100.0",
        "-",
    ]


def test_figures_have_a_point_a_number() -> None:
    own = lines_of_all()
    drawn = plots.size_figure(own)
    assert drawn is not None
    heights = points(drawn)
    assert len(heights) == 3 * (5 + 2 + 1)  # two tasks and their mean: the paper, MLP at two sizes, ACT at one
    assert {44.0, 80.0, 90.0} <= {round(height, 2) for height in heights}  # 44 is the mean of two seeds
    low, high = wilson(200, 250)
    assert round(100 * (high - low), 2) in whiskers(drawn)
    _, low, high = rates.mean_rate([[make_line(successes=200)]] * 2)
    assert round(100 * (high - low), 2) in whiskers(drawn)
    barred = plots.architectures_figure(own)
    assert barred is not None
    bars = [bar for axes in barred.axes for bar in axes.patches if isinstance(bar, Rectangle)]
    assert len(bars) == 2 * (3 + 2)
    assert {80.0, 90.0} <= {round(bar.get_height(), 2) for bar in bars}
    larger = [make_line(dataclasses.replace(CELL, num_train_episodes=5000, policy=name)) for name in ("mlp", "act")]
    third = make_line(dataclasses.replace(CELL, num_train_episodes=1000, policy="diffusion"))
    for chosen, size in (([*own, *larger], 5000), ([*own, *larger, third], 1000)):
        found = plots.architectures_figure(chosen)
        assert found is not None
        titles = [axes.get_title("left") for axes in found.axes]
        assert f"LiftBox, {size} episodes" in titles, "the size that most policies have"
    assert plots.size_figure(own, "paper") is plots.regions_figure([]) is None


def test_a_figure_is_the_same_svg_every_time() -> None:
    one, two = (plots.size_figure(lines_of_all()) for _ in range(2))
    assert one is not None and two is not None
    text = drawing.svg(one)
    assert text == drawing.svg(two)
    root = ET.fromstring(text)
    assert (root.get("width"), root.get("height")) == (str(3 * plots.WIDTH), str(plots.HEIGHT + plots.LEGEND))
    said = [element.text for element in root.iter() if element.tag.endswith("text")]
    assert {"GraspCube", "mean of 2 tasks", "5000", "paper (ACT)"} <= set(said), "text stays text"
    assert "mlp: 80.0 % (74.6 to 84.5)" in [element.text for element in root.iter() if element.tag.endswith("title")]
    assert not any(group.get("id") for group in root.iter("{http://www.w3.org/2000/svg}g"))


def make_rollout(seed: int, x: float, y: float, outcome: str) -> Rollout:
    held = outcome == "success"
    return Rollout(
        task="LiftBox",
        policy="chunked_mlp",
        policy_hash="0" * 64,
        region="R3",
        seed=seed,
        success_ever=held,
        success_end=held,
        success_held=held,
        outcome=outcome,
        length_s=9.0,
        initial_state={"robot": [x, y, 0.0], "object": [0.0, 0.0, 0.0]},
    )


def test_failure_map_counts_where_they_began() -> None:
    starts = [(-1.0, 0.0), (-1.0, 0.0), (-0.2, 0.1), (-0.2, -0.1)]
    rollouts = [make_rollout(place, x, y, "fell" if place == 1 else "success") for place, (x, y) in enumerate(starts)]
    drawn = ET.fromstring(drawing.svg(plots.failure_map(rollouts, bins=4)))
    titles = [element.text for element in drawn.iter() if element.tag.endswith("title")]
    assert titles.count("1 of 2 failed") == 1
    assert sum(int((title or "").split()[2]) for title in titles) == 4
    assert [element.text for element in drawn.iter() if element.text == "1/2"] == ["1/2"]


def test_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = layout(tmp_path)
    for line in lines_of_all():
        lines.append(own.policies_file, "demohlm reproduce --table main", line)
    outcomes = ["success", "fell", "fell", "dropped"]
    rollouts = [make_rollout(seed, -0.3 * seed, 0.1, outcome) for seed, outcome in enumerate(outcomes)]
    checkpoint(own.training(CELL)).mkdir(parents=True)
    jsonl.append(own.rollouts(CELL), map(dataclasses.asdict, rollouts))
    filmed: list[int] = []

    def fake(failure: page.Failure) -> page.Video:
        filmed.append(failure.seed)
        return page.Video(mp4="AA", caption="a <fall>")

    monkeypatch.setattr(page, "_film", fake)
    words = ["report", "--results", str(own.results), "--experiments", str(own.root), "--num-videos", "2"]
    assert cli.main([*words, "--output", str(tmp_path / "page.html"), "--figures", str(tmp_path / "figures")]) == 0
    assert filmed == [1, 3]  # one of each outcome
    text = (tmp_path / "page.html").read_text()
    assert text.count("a &lt;fall&gt;") == 2
    assert "<td>LiftBox</td>" in text
    assert "LiftBox: MLP, 100 episodes, seed 0" in text
    assert text.count("<h3>LiftBox: ") == 1
    names = sorted(file.name for file in (tmp_path / "figures").iterdir())
    assert names == ["architectures_cpu.svg", "sizes_cpu.svg"]
    assert cli.main(["report", "--results", str(tmp_path / "no"), "--output", str(tmp_path / "other.html")]) == 2


def test_films_are_of_the_failure_that_was_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = films.Take(
        task=get_task("LiftBox"),
        variation=get_variation("real"),
        initial_state={},
        snapshots=[],
        origin="mlp",
        outcome="dropped",
        length_s=3.0,
    )
    asked: list[tuple[object, ...]] = []

    def roll_out(*words: object) -> films.Take:
        asked.append(words)
        return take

    monkeypatch.setattr(page, "policy_take", roll_out)

    def write(_take: films.Take, root: Path, **_options: object) -> None:
        (root / "lift_box_overview.mp4").write_bytes(b"film")

    monkeypatch.setattr(page, "write_take", write)
    cell = dataclasses.replace(CELL, region="R4", variation="real", perception="rgbd")
    failures = [page.Failure(cell=cell, seed=3, outcome=outcome, policy=tmp_path) for outcome in ("fell", "dropped")]
    other, same = page.film_failures(failures)
    assert asked == [(get_task("LiftBox"), "R4", 3, tmp_path, "real", "rgbd")] * 2
    assert other is None
    assert same is not None and same.mp4 == "ZmlsbQ==" and "mlp" in same.caption
