"""`demohlm controllers` lists what is installed, with the numbers of the whole range of commands."""

import json
from pathlib import Path

import pytest

from gym_demohlm import jsonl
from gym_demohlm.control import controllers
from lerobot_demohlm import cli
from tests.helpers.paths import REPOSITORY


def test_every_controller_is_listed_with_its_latest_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    default = next(controller for controller in controllers.installed() if controller.is_default)
    lines = [
        {"controller": default.name, "survival": survival, "velocity_only": light}
        for survival, light in ((0.5, False), (0.9375, False), (1.0, True))
    ]
    jsonl.append(tmp_path / "controller.jsonl", [*lines, {"survival": 0.1}])
    assert cli.main(["controllers", "--results", str(tmp_path / "controller.jsonl")]) == 0
    *table, last = capsys.readouterr().out.splitlines()
    rows = json.loads(last)
    assert [row["name"] for row in rows] == [controller.name for controller in controllers.installed()]
    assert [row["default"] for row in rows] == [True] + [False] * (len(rows) - 1)
    assert rows[0]["survival"] == 0.9375
    assert rows[0]["linear_velocity_error"] is None
    assert len(table) == 1 + len(rows)
    assert "(default)" in table[1] and "0.938" in table[1]


def test_the_package_has_the_numbers_of_each_of_its_controllers(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["controllers"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert all(0.5 < row["survival"] <= 1.0 for row in rows)
    measured = jsonl.read(REPOSITORY / "results/controller.jsonl")
    assert all(line in measured for line in jsonl.read(controllers.MEASURED))


def test_a_controller_is_tuned_by_names_and_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "tuned.npz"
    assert (
        cli.main(["tune-controller", "--gait", "recovery_s=7.5", "capture=[0.1,0.09,0.12]", "--output", str(path)]) == 0
    )
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["hash"] == controllers.load(str(path)).hash
    assert controllers.load(str(path)).settings.gait.recovery_s == 7.5
    output = ["--output", str(tmp_path / "bad.npz")]
    for wrong, message in (
        ("recovery_s=four", "NAME=VALUE"),
        ("recovery=4", "recovery_spread"),
        ("spread=-0.3", "0 to 0.5 m"),
        ("lift=-5", "0 to 0.5 m"),
        ("recovery_spread=3", "0 to 0.5 m"),
    ):
        assert cli.main(["tune-controller", "--gait", wrong, *output]) == 2
        assert message in capsys.readouterr().err
    assert cli.main(["tune-controller", "nosuch.npz", "--gait", "lift=0.05", *output]) == 2
    assert "no file nosuch.npz" in (told := capsys.readouterr().err) and "--gait" not in told
    assert not (tmp_path / "bad.npz").exists()
