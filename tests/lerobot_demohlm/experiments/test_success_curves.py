"""Curves of success: what is drawn, and what the measures make of their lines."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import pytest
from matplotlib.axes import Axes

from gym_demohlm import jsonl
from gym_demohlm.errors import DatasetError
from lerobot_demohlm.benchmarks import perception_curves
from lerobot_demohlm.cli.benchmark.perception import Options, run
from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.perception_tables import curves_table
from lerobot_demohlm.experiments.success_curves import Panel, draw_panels
from tests.helpers.checkpoints import save_policy


@pytest.fixture
def plotted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, tuple[float, ...]]]:
    """Return name and x of every curve as it is drawn."""
    found: list[tuple[str, tuple[float, ...]]] = []
    plot = Axes.plot

    def spy(self: Axes, *args: Any, **options: Any) -> Any:
        found.append((options["label"], tuple(args[0])))
        return plot(self, *args, **options)

    monkeypatch.setattr(Axes, "plot", spy)
    return found


def test_a_curve_needs_two_points(tmp_path: Path, plotted: list[tuple[str, tuple[float, ...]]]) -> None:
    one, two = [(0.0, 0.9, 0.8, 1.0)], [(0.0, 0.9, 0.8, 1.0), (1.0, 0.5, 0.4, 0.6)]
    panels = [Panel(title="a", label="x", curves={"few": one}), Panel(title="b", label="x", curves={"enough": two})]
    draw_panels(panels, "success", tmp_path / "new" / "curves.png", panel_size=(2.0, 2.0))
    assert plotted == [("enough", (0.0, 1.0))]
    assert (tmp_path / "new" / "curves.png").stat().st_size > 1000


def test_a_curve_has_one_colour_in_all_panels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where another one is missing."""
    colours: dict[str, set[str]] = {}
    plot = Axes.plot

    def spy(self: Axes, *args: Any, **options: Any) -> Any:
        (line,) = plot(self, *args, **options)
        colours.setdefault(options["label"], set()).add(str(line.get_color()))
        return [line]

    monkeypatch.setattr(Axes, "plot", spy)
    points = [(0.0, 0.9, 0.8, 1.0), (1.0, 0.5, 0.4, 0.6)]
    both = Panel(title="a", label="x", curves={"first": points, "second": points})
    panels = [both, Panel(title="b", label="x", curves={"first": [], "second": points})]
    draw_panels(panels, "success", tmp_path / "curves.png", panel_size=(2.0, 2.0))
    assert [len(found) for found in colours.values()] == [1, 1]
    assert colours["first"] != colours["second"]


def test_lines_become_curves_of_every_axis(tmp_path: Path, plotted: list[tuple[str, tuple[float, ...]]]) -> None:
    lines = tmp_path / "lines.jsonl"
    facts: dict[str, Any] = {"task": "LiftBox", "region": "R3", "policy": "mlp", "policy_hash": "ab"}
    success = {"rate": 0.8, "interval": [0.7, 0.9]}
    found = perception_curves.conditions(list(perception_curves.AXES))
    lines.write_text(
        "".join(json.dumps(facts | {"perception": str(c), "success_strict": success}) + "\n" for c in found)
    )
    perception_curves.draw(lines, tmp_path / "curves.png")
    values = [values for _, values in perception_curves.AXES.values()]
    assert len(plotted) == len(values)
    assert all(set(expected) <= set(x) for (_, x), expected in zip(plotted, values, strict=True))


def test_an_axis_that_was_not_measured_has_no_panel(
    tmp_path: Path, plotted: list[tuple[str, tuple[float, ...]]]
) -> None:
    lines = tmp_path / "lines.jsonl"
    line: dict[str, Any] = {
        "task": "LiftBox",
        "region": "R3",
        "policy": "mlp",
        "policy_hash": "ab",
        "perception": "exact",
    }
    line |= {"success_strict": {"rate": 0.8, "interval": [0.7, 0.9]}}
    lines.write_text(json.dumps(line) + "\n")
    with pytest.raises(DatasetError, match="no curve"):
        perception_curves.draw(lines, tmp_path / "curves.png")
    lines.write_text("".join(json.dumps(line | {"perception": p}) + "\n" for p in ("exact", "exact,latency_s=0.4")))
    perception_curves.draw(lines, tmp_path / "curves.png")
    assert [x for _, x in plotted] == [(0.0, 0.4)]
    width, height = matplotlib.image.imread(tmp_path / "curves.png").shape[1::-1]
    assert width < 1.5 * height  # one panel


def test_of_two_policies_of_a_kind_the_one_measured_last_is_drawn(
    tmp_path: Path, plotted: list[tuple[str, tuple[float, ...]]]
) -> None:
    lines = tmp_path / "lines.jsonl"
    line: dict[str, Any] = {"task": "LiftBox", "region": "R3", "policy": "mlp"}
    line |= {"success_strict": {"rate": 0.8, "interval": [0.7, 0.9]}}
    found = [("ab", 0.1), ("ab", 0.4), ("cd", 0.2), ("cd", 0.4)]
    lines.write_text(
        "".join(
            json.dumps(line | {"policy_hash": policy, "perception": f"exact,latency_s={latency_s}"}) + "\n"
            for policy, latency_s in found
        )
    )
    perception_curves.draw(lines, tmp_path / "curves.png")
    assert [x for _, x in plotted] == [(0.2, 0.4)]


def test_what_is_measured_is_not_measured_again(tmp_path: Path) -> None:
    policy = save_policy(tmp_path / "policy")
    once = Options(policy=policy, axes=(), perceptions=("exact,bias_mm=5",), num_episodes=1, results=tmp_path)
    run(once)
    (first,) = jsonl.read(tmp_path / "perception_curves.jsonl")
    assert first["episodes"] == 1 and first["success_strict"]["rate"] == 0.0  # it stands still
    run(replace(once, perceptions=("exact,bias_mm=5", "model")))
    again = list(jsonl.read(tmp_path / "perception_curves.jsonl"))
    assert again[0] == first and [line["perception"] for line in again[1:]] == ["model"]


def test_a_table_has_a_column_a_policy_and_the_newest_line_of_each_perception() -> None:
    facts = {"task": "LiftBox", "region": "R3", "policy": "mlp", "policy_hash": "ab", "perception": "exact"}
    old, new = (facts | {"success_strict": {"rate": rate, "interval": [0.7, 0.95]}} for rate in (0.8, 0.9))
    other = new | {"task": "GraspCube", "policy_hash": "cd", "perception": "model"}
    table = curves_table([Measurement(values=line, command="", commit="") for line in (old, new, other)])
    assert "| perception | GraspCube R3, mlp | LiftBox R3, mlp |" in table
    assert "| `exact` |  | 90 % (70 to 95) |" in table
    assert "| `model` | 90 % (70 to 95) |  |" in table
