"""Result lines -> README tables."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm.errors import DatasetError
from gym_demohlm.wbc.evaluation.contest import PROTOCOLS
from lerobot_demohlm.experiments import (
    controller_tables,
    lines,
    measured_tables,
    paper,
    readme_tables,
    varied_tables,
)
from lerobot_demohlm.experiments.lines import GenerationResult
from lerobot_demohlm.experiments.variants import stamp
from lerobot_demohlm.reproducibility.results import append_result
from tests.helpers.experiment_lines import CELL, make_line
from tests.helpers.paths import REPOSITORY


def test_lines_become_tables_that_say_their_age(tmp_path: Path) -> None:
    facts = GenerationResult(
        task="LiftBox",
        region="R3",
        attempts=100,
        successes=93,
        outcomes={"success": 93, "fell": 7},
        stamp=stamp("LiftBox"),
    )
    path = tmp_path / "generation.jsonl"
    lines.append(path, "demohlm generate ...", dataclasses.replace(facts, successes=1))
    lines.append(path, "demohlm generate ...", facts)
    outcomes = {"success": 97, "fell": 3}
    again = dataclasses.replace(facts, successes=97, retries=2, first_try_successes=93, outcomes=outcomes, stamp="old")
    lines.append(path, "demohlm generate --retries 2 ...", again)
    page = tmp_path / "docs" / "results.md"
    assert readme_tables.write_results(page, tmp_path)
    text = page.read_text()
    assert "| LiftBox | R3 | 100 | 93.0 (86.3 to 96.6) | 91.2 | fell 7 |" in text
    assert "| 97.0 (91.5 to 99.0), at the first try 93.0, with up to 2 retries | 91.2 | fell 3 |" in text
    assert text.count("| LiftBox |") == 2  # the last line of a task, region and number of retries counts
    made_at = lines.read_generation(path)[0].commit
    assert f"*Measured at commit {made_at}.*" in text
    assert f"{made_at}, an earlier version |" in text and "*Rows marked" in text
    assert "**Exact poses.**" in text and "**Shared starts.**" in text
    assert not readme_tables.write_results(page, tmp_path), "the same lines give the same page"


def test_strict_successes_stand_beside_held_ones(tmp_path: Path) -> None:
    made = GenerationResult(
        task="LiftBox", region="R3", attempts=100, successes=93, strict_successes=91, stamp=stamp("LiftBox")
    )
    path = tmp_path / "generation.jsonl"
    lines.append(path, "demohlm generate ...", made)
    lines.append(
        path, "demohlm generate ...", dataclasses.replace(made, variation="real", successes=80, first_try_successes=78)
    )
    lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", make_line(CELL, 200, successes_strict=150))
    text = readme_tables.tables(tmp_path)
    assert "| LiftBox | R3 | 100 | 93.0 (86.3 to 96.6), strict 91.0 |" in text
    assert "80.0 (71.1 to 86.7), strict 91.0, at the first try 78.0, in worlds that vary by real |" in text
    assert "80.0 (74.6 to 84.5), strict 60.0" in text  # of the policy
    row = "| LiftBox | 93.0 | 91.0, an earlier version | - |"
    assert row in varied_tables.readme_table(tmp_path)


def test_measurements_without_a_stamp_are_of_an_earlier_version(tmp_path: Path) -> None:
    shares = {f"{name}_share": 0.2 for name in measured_tables.SHARES}
    values = {"task": "LiftBox", "region": "R3", "attempts": 8, "successes": 7, **shares}
    values |= {"seconds_per_episode": 1.5, "simulated_s_per_episode": 14.0}
    path = tmp_path / "generation_time.jsonl"
    lines.append(path, "demohlm benchmark generation", lines.Measurement(values=values))
    assert "| LiftBox, an earlier version | R3 | 7 of 8 |" in readme_tables.tables(tmp_path)
    now = lines.Measurement(values=values | {"stamp": stamp("LiftBox")})
    lines.append(path, "demohlm benchmark generation", now)
    assert "| LiftBox | R3 | 7 of 8 |" in readme_tables.tables(tmp_path)


def test_the_readme_has_one_row_a_task(tmp_path: Path) -> None:
    varied_cell = dataclasses.replace(CELL, num_train_episodes=1000, variant="real", variation="real")
    for change, successes in (
        ({}, 200),
        ({"train_seed": 1}, 210),
        ({"policy": "act"}, 225),
        ({"num_train_episodes": 100}, 1),
        ({"variation": "none"}, 2),
        ({"variant": "noise"}, 3),
        ({"perception": "rgbd"}, 4),
        ({"region": "R4"}, 5),
    ):
        line = make_line(dataclasses.replace(varied_cell, **change), 240, successes_strict=successes)
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", line)
    made = GenerationResult(task="LiftBox", region="R3", attempts=500, successes=499, stamp=stamp("LiftBox"))
    lines.append(tmp_path / "generation.jsonl", "demohlm generate ...", made)
    varied = {"variation": "real", "successes": 470, "strict_successes": 465}
    for task, made_by in (("LiftBox", stamp("LiftBox", "real")), ("StackCube", "old")):
        line = dataclasses.replace(made, task=task, stamp=made_by, **varied)
        lines.append(tmp_path / "generation.jsonl", "demohlm reproduce", line)
    readme = tmp_path / "README.md"
    readme.write_text("top\n<!-- results -->\nold\n<!-- /results -->\nbottom\n")
    assert readme_tables.update_page(readme, tmp_path)
    text = readme.read_text()
    assert "| LiftBox | 99.8 | 93.0 | 82.0 | 90.0 | - | 91.2 | 98.8 |" in text
    assert "| StackCube | - | 93.0, an earlier version | - | - | - | - | - |" in text
    assert text.count("An earlier version is one from before") == 1, "what a cell says is explained where one says it"
    assert "| PressCube | - | - | - | - | - | 92.5 | 85.2 |" in text
    assert text.count("\n| ") == 1 + 10 + 1 + 1
    assert "| mean | - | - | - | - | - | - | - |" in text, "no column has every task"
    assert "500 attempts, without the noise" in text and "250 rollouts in `real` worlds" in text
    assert "old" not in text and text.startswith("top") and text.endswith("bottom\n")
    assert not readme_tables.update_page(readme, tmp_path)
    for text, wrong in (("nothing", "without markers"), ("<!-- results --> at the end", "with one of")):
        readme.write_text(text)
        with pytest.raises(DatasetError, match=wrong):
            readme_tables.update_page(readme, tmp_path)
        assert readme.read_text() == text


def test_a_page_may_have_tables_of_the_widest_region(tmp_path: Path) -> None:
    cell = dataclasses.replace(CELL, num_train_episodes=1000, variant="real", variation="real", region="R4")
    for task in paper.SUCCESS_BY_SIZE:
        for change, successes in (
            ({}, 150),
            ({"train_seed": 1}, 200),
            ({"num_train_episodes": 100}, 50),
            ({"num_train_episodes": 100, "steps": 1}, 75),
            ({"num_train_episodes": 5000, "steps": 1}, 125),
            ({"policy": "act"}, 225),
            ({"policy": "diffusion", "steps": 1}, 25),
            ({"region": "R3"}, 1),
        ):
            if task == "LiftBox" or change.get("policy") != "diffusion":
                changed = dataclasses.replace(cell, task=task, **change)
                line = make_line(changed, 240, successes_strict=successes + 25 * (task == "PourWater"))
                lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", line)
    page = tmp_path / "policies.md"
    page.write_text("<!-- widest -->\n<!-- /widest -->\n<!-- sizes -->\n<!-- /sizes -->\n")
    assert readme_tables.update_page(page, tmp_path)
    rows = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    assert rows[0] == "| task | generation | MLP | ACT | Diffusion |" and len(rows) == 1 + 10 + 1 + 1 + 2 * 10
    assert "| LiftBox | - | 70.0 | 90.0 | 10.0 |" in rows and "| PourWater | - | 80.0 | 100.0 | - |" in rows
    assert "| mean | - | 71.0 | 91.0 | - |" in rows
    assert "| task | policy | 100 episodes | 1000 episodes | 5000 episodes |" in rows
    assert "| LiftBox | MLP | 20.0 | 70.0 | - |" in rows, "ACT has one size"
    assert "| LiftBox | MLP, 1 steps | 30.0 | - | 50.0 |" in rows
    aged = make_line(dataclasses.replace(cell, policy="act"), 240, successes_strict=225, stamp="old")
    lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", aged)
    assert "| mean | - | 71.0 | 91.0, an earlier version | - |" in varied_tables.widest_table(tmp_path)


def test_a_page_may_have_a_table_of_generation_by_region(tmp_path: Path) -> None:
    made = GenerationResult(task="LiftBox", region="R3", attempts=250, successes=250, stamp=stamp("LiftBox"))
    for change in (
        {"strict_successes": 200},
        {"strict_successes": 240, "task": "PressCube", "stamp": stamp("PressCube")},
        {"strict_successes": 100, "command_noise": 1.0},
        {"region": "R1"},  # from before strict success was judged
        {"strict_successes": 150, "region": "R4", "variation": "real", "stamp": "old"},
    ):
        lines.append(tmp_path / "generation.jsonl", "demohlm reproduce", dataclasses.replace(made, **change))
    assert varied_tables.generation_table(tmp_path).splitlines()[2:] == [
        "| `none` | R3 | 2 | 80.0 | 88.0 |",
        "| `real` | R4 | 1 | 60.0, an earlier version | 60.0, an earlier version |",
    ]


def test_a_page_may_have_tables_that_compare_trainings(tmp_path: Path) -> None:
    cell = dataclasses.replace(CELL, num_train_episodes=1000, variant="real", variation="real", steps=8000)
    for change, successes, others in (
        ({}, 100, {}),
        ({"train_seed": 1}, 110, {}),
        ({"steps": 24000}, 150, {}),
        ({"task": "PressCube"}, 200, {}),
        ({"task": "PressCube", "train_seed": 1}, 200, {"train_device": "cuda"}),
        ({"task": "PressCube", "steps": 24000}, 225, {}),
        ({"variant": "noise"}, 25, {}),
        ({"variant": "noise", "variation": "none"}, 250, {}),
        ({"region": "R4"}, 50, {"stamp": "old"}),
        ({"region": "R4", "steps": 24000}, 75, {}),
        ({"region": "R4", "num_train_episodes": 100, "steps": 48000}, 75, {}),
        ({"steps": 48000}, 160, {"stamp": "old"}),
    ):
        line = make_line(dataclasses.replace(cell, **change), 250, successes_strict=successes, **others)
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", line)
    page = tmp_path / "policies.md"
    page.write_text("".join(f"<!-- {name} -->\n<!-- /{name} -->\n" for name in ("steps", "seeds", "plain data")))
    assert readme_tables.update_page(page, tmp_path)
    assert [line for line in page.read_text().splitlines() if line.startswith("| ")] == [
        "| task | region | policy | 8,000 steps | 24,000 steps | 48,000 steps | p |",
        # 210 of 500, then 150 of 250; the longest is of other data
        "| LiftBox | R3 | MLP | 42.0 | 60.0 | 64.0, an earlier version | below 0.001 |",
        "| PressCube | R3 | MLP | 80.0 | 90.0 | - | - |",  # one was trained on a GPU
        "| LiftBox | R4 | MLP | 20.0, an earlier version | 30.0 | - | - |",
        "| mean of 2 tasks | R3 | MLP | 61.0 | 75.0 | 77.0, an earlier version | - |",
        "| mean of 2 tasks | R4 | MLP | - | - | - | - |",
        "| task | region | policy | each training |",
        "| LiftBox | R3 | MLP | 40.0, 44.0 |",
        "| PressCube | R3 | MLP | 80.0, 80.0, trained on cuda |",
        "| task | policy | of plain data | of `real` data |",
        "| LiftBox | MLP | 10.0 | 42.0 |",
    ]


def test_a_page_may_have_a_table_of_how_policies_see(tmp_path: Path) -> None:
    cell = dataclasses.replace(CELL, num_train_episodes=1000, variant="real")
    for change, successes, others in (
        ({}, 249, {}),
        ({"perception": "rgbd"}, 247, {"stamp": "old"}),
        ({"perception": "model"}, 30, {"episodes": 48}),
        ({"perception": "apriltag", "train_seed": 1}, 1, {}),
        ({"task": "PressCube"}, 250, {}),  # seen in one way only
    ):
        line = make_line(dataclasses.replace(cell, **change), 249, successes_strict=successes, **others)
        lines.append(tmp_path / "experiments.jsonl", "demohlm reproduce", line)
    page = tmp_path / "perception.md"
    page.write_text("<!-- perception -->\n<!-- /perception -->")
    assert readme_tables.update_page(page, tmp_path)
    rows = [line for line in page.read_text().splitlines() if line.startswith("| ")]
    assert rows[1:] == ["| LiftBox | MLP | 249 | 247, an earlier version | 30 of 48 | - | - |"]


def test_controllers_stand_side_by_side_each_with_its_newest_numbers(tmp_path: Path) -> None:
    numbers = {name: 0.08 for name in controller_tables.NUMBERS} | {"num_worlds": 8, "seconds": 20.0}
    old = {name: value for name, value in numbers.items() if not name.endswith("_cycle")}  # a line without a controller
    new = {**numbers, "controller": "0123456789ab", "velocity_only": False, "survival": 0.99, "survival_low": 0.975}
    path = tmp_path / "controller.jsonl"
    for line in (old, {**old, "peer": "holosoma"}, {**new, "survival": 0.5}, new, {**new, "velocity_only": True}):
        append_result(path, "demohlm benchmark controller", line)
    text = readme_tables.tables(tmp_path)
    first = controller_tables.FIRST
    header = f"|  | `0123456789ab` | `0123456789ab`, velocity commands only | `{first}` | best published |"
    assert header in text
    assert "holosoma" not in text
    assert "| linear velocity error over a gait cycle | 0.080 m/s | 0.080 m/s | - | - |" in text
    assert "| no fall in an episode | 99.0 % (97.5) | 99.0 % (97.5) | 8.0 % | - |" in text
    assert "| height error, standing | 0.0800 m | 0.0800 m | 0.0800 m | 0.0280 m |" in text
    assert "how they are defined is not known" in text


def test_pairs_have_their_intervals_and_ablations_say_what_is_clear(tmp_path: Path) -> None:
    def line(controller: str, protocol: str, names: Iterable[str], low: float) -> dict[str, Any]:
        rows = [{"name": name, "new": 0.25, "old": 0.08, "low": low, "high": 0.2} for name in names]
        size = {"num_worlds": 96, "num_seeds": 2, "seconds": 12.0, "seed": 0, "physics": "second"}
        return {"protocol": protocol, "controller": controller, "beside": "0123456789ab", "rows": rows, **size}

    path = tmp_path / "controller_pairs.jsonl"
    for low in (-0.3, 0.15):
        append_result(path, "paired", line("holosoma", "arms", PROTOCOLS["arms"].rows, low))
    append_result(path, "ablation", line("without sway", "whole", PROTOCOLS["whole"].rows, 0.1))
    append_result(path, "ablation", line("without turn", "whole", PROTOCOLS["whole"].rows, -0.1))
    text = readme_tables.tables(tmp_path)
    assert "|  | `0123456789ab` | holosoma (difference, 95 %) |" in text
    assert "| mechanical power, walking | 0.1 W | 0.2 W (+0.1 to +0.2) |" in text
    assert "| no fall in an episode | 8.0 % | 25.0 % (+15.0 to +20.0) |" in text
    assert "| all parts | 0.080 m/s |" in text
    assert "| without sway | **0.250 m/s** |" in text
    assert "| without turn | 0.250 m/s |" in text


def test_speed_workers_and_faults_become_tables(tmp_path: Path) -> None:
    speed = {"episodes_per_s": 110.0, "lerobot_episodes_per_s": 5.0, "write_speedup": 22.0, "benchmark": "dataset"}
    memory = {"benchmark": "memory", "run_episodes": 50, "rss_after_a_tenth_mb": 500, "rss_after_all_mb": 505}
    trained = {"benchmark": "training", "preset": "cpu", "batch_size": 512, "lerobot_num_workers": 4, "ratio": 50.0}
    rates = {"samples_per_s": 10_000.0, "lerobot_samples_per_s": 200.0}
    trainings = [{**trained, **rates, "policy": policy} for policy in ("mlp", "act")]
    for line in (speed, memory, *trainings):
        append_result(tmp_path / "speed.jsonl", "demohlm benchmark dataset", line)
    runs = [{"backend": "ray", "workers": 2, "attempts_per_hour": 5000, "same": same} for same in (True, False)]
    compared = {"task": "LiftBox", "region": "R3", "attempts": 64, "files": 9, "runs": runs}
    append_result(tmp_path / "workers.jsonl", "python benchmarks/workers.py", compared)
    fault = {"fault": "kill -9", "tried": 50, "survived": 49, "lost": 1, "note": ""}
    append_result(tmp_path / "faults.jsonl", "python -m lerobot_demohlm.benchmarks.faults", {"faults": [fault]})
    fuzzed = {"seconds": 3600, "executions": 100_000, "broke": False}
    append_result(tmp_path / "fuzzing.jsonl", "python benchmarks/fuzz_loaders.py --seconds 3600", fuzzed)
    text = readme_tables.tables(tmp_path)
    assert "| state-only episodes written a second | 110.0 | 5.0 (LeRobot's `save_episode`) | 22 |" in text
    assert "| 505 after 50 episodes | 500 (after a tenth of its episodes) | 1.01 |" in text
    for policy in ("mlp", "act"):
        assert f"a second ({policy}, cpu, batch 512) | 10,000.0 | 200.0 (`lerobot-train`, 4 processes" in text
    assert "| 2, ray | 5,000 | yes |" in text and "| 2, ray | 5,000 | **no** |" in text
    assert "| kill -9 | 50 | 49 | 1 |" in text
    assert "| 100,000 | 3600 s | none |" in text


def test_damaged_line_is_a_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "generation.jsonl"
    path.write_text('{"task": "LiftBox", "region": "R3", "attempts": 1, "successes": 1}\nbroken\n')
    with pytest.raises(DatasetError, match=r"generation\.jsonl:2"):
        lines.read_generation(path)
    path.write_text('{"task": "LiftBox", "region": "R3", "attempts": "many", "successes": 1}\n')
    with pytest.raises(DatasetError, match=r"generation\.jsonl:1 with attempts='many'; expected int"):
        lines.read_generation(path)
    path.write_text('{"task": "LiftBox"}\n')
    with pytest.raises(DatasetError, match=r"generation\.jsonl:1 without region, attempts, successes"):
        lines.read_generation(path)


def test_the_committed_results_are_what_is_shown(tmp_path: Path) -> None:
    page = REPOSITORY / "docs" / "results.md"
    shown = readme_tables.results_page(REPOSITORY / "results")
    assert page.read_text() == shown, "run: demohlm results --output docs/results.md"
    for name in ("README.md", "docs/perception.md", "docs/policies.md", "docs/variation.md"):
        copy = tmp_path / "page.md"
        copy.write_text((REPOSITORY / name).read_text())
        assert not readme_tables.update_page(copy, REPOSITORY / "results"), f"run: demohlm results --pages {name}"


def test_every_committed_line_can_be_read() -> None:
    folder = REPOSITORY / "results"
    assert len(lines.read_policies(folder / "experiments.jsonl")) > 50
    assert len(lines.read_generation(folder / "generation.jsonl")) >= 30
    assert all(lines.read_measurements(path) for path in folder.glob("*.jsonl"))
