"""How near seen poses come to the truth: measured from a shell, and shown in tables."""

from pathlib import Path

import pytest

from gym_demohlm import jsonl
from lerobot_demohlm.cli import main
from lerobot_demohlm.experiments.lines import Measurement
from lerobot_demohlm.experiments.perception_tables import fit_table, tracking_table
from lerobot_demohlm.experiments.variants import stamp


def test_seen_poses_are_measured_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = ["benchmark", "tracking", "--tasks", "PressCube", "--num-episodes", "1", "--region", "R1"]
    assert main([*call, "--results", str(tmp_path)]) == 0
    (line,) = jsonl.read(tmp_path / "tracking.jsonl")
    assert line["command"] == "demohlm " + " ".join([*call, "--seed", "21"])
    assert 0.0 < line["position_mm"]["median"] < 4.0 and line["turn_deg"]["median"] < 4.0
    assert line["frames"] >= line["frames_seen"] > 50 and line["lost_share"] < 0.05
    assert line["frame_cpu_ms"]["median"] > 0.0
    assert tracking_table([_measured(line)]) in capsys.readouterr().out


@pytest.mark.slow
def test_shapes_alone_do_not_tell_the_sides_of_r4s_marked_cube(tmp_path: Path) -> None:
    call = ["benchmark", "tracking", "--tasks", "GraspCube", "--num-episodes", "1", "--seed", "970000"]
    assert main([*call, "--region", "R4", "--results", str(tmp_path)]) == 0
    (line,) = jsonl.read(tmp_path / "tracking.jsonl")
    assert line["position_mm"]["median"] < 4.0
    assert abs(line["turn_deg"]["median"] - 90.0) < 4.0, "the episode's cube is a quarter turn off"


def test_tables_show_the_newest_of_each_object() -> None:
    old, new = ({**_TRACKED, "position_mm": {"median": value, "p95": 5.0}} for value in (1.0, 2.0))
    table = tracking_table([_measured(old), _measured(new)])
    assert "| LiftBox box | 90 of 100 | 2 (5) | 0.1 (0.3) | 1.0 % | 1 | 9 (20) |" in table
    assert table.count("LiftBox") == 1 and table.startswith(
        "**Object poses as `rgbd` sees them**, an earlier version\n"
    )
    other = {**_TRACKED, "task": "PressCube", "object": "cube", "stamp": stamp("PressCube")}
    table = tracking_table([_measured(new), _measured(other)])
    assert "| LiftBox box, an earlier version |" in table and "| PressCube cube |" in table and "them**\n" in table


def test_fits_are_shown_and_other_lines_of_their_file_are_not() -> None:
    quantiles = {"shift_mm_q50": 0.428, "shift_mm_q90": 1.57, "turn_deg_q50": 0.112, "turn_deg_q90": 37.0}
    fit = {"task": "LiftBox", "object": "box", "fitted_to": {"attempts": 20}, "fresh_attempts": 10}
    fit |= {"rgbd": quantiles, "model": quantiles, "largest_deviation": 0.049}
    table = fit_table([_measured(fit), _measured({"what": "speed", "task": "LiftBox"})])
    assert "| LiftBox box | 20, 10 | 0.43, 0.43 | 1.6, 1.6 | 0.11, 0.11 | 37, 37 | 5 % |" in table


def test_no_episode_is_refused(tmp_path: Path) -> None:
    assert main(["benchmark", "tracking", "--num-episodes", "0", "--results", str(tmp_path)]) == 2
    assert not list(tmp_path.iterdir())


_TRACKED = {
    "task": "LiftBox",
    "object": "box",
    "frames": 100,
    "frames_seen": 90,
    "position_mm": {"median": 1.0, "p95": 5.0},
    "turn_deg": {"median": 0.1, "p95": 0.3},
    "lost_share": 0.01,
    "found_again_late": 1,
    "frame_cpu_ms": {"median": 9.0, "p95": 20.0},
}


def _measured(line: dict[str, object]) -> Measurement:
    return Measurement(values=line, command="", commit="")
