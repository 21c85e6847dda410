"""The examples run as they stand."""

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import imageio.v3 as iio
import pytest

from gym_demohlm import poses, registry
from gym_demohlm.control import command
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.teleop import record
from tests.helpers.hold import HoldController
from tests.helpers.paths import REPOSITORY


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_drive_by_hand(tmp_path: Path) -> None:
    _load("drive_by_hand").main(tmp_path)
    for name in ("walk", "stand", "squat"):
        assert iio.imread(tmp_path / f"{name}.png").std() > 10  # a picture of something


def test_generate_and_look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _load("generate_and_look").main(tmp_path / "data", num_attempts=2)
    printed = capsys.readouterr().out
    assert "2 of 2 attempts succeeded" in printed
    assert "observation.environment_state: float32 (9,)" in printed


@pytest.mark.slow
def test_train_and_evaluate(tmp_path: Path) -> None:
    _load("generate_and_look").main(tmp_path / "data", num_attempts=2)
    _load("train_and_evaluate").main(tmp_path / "data", tmp_path, steps=3, episodes=2)
    assert (tmp_path / "eval" / "eval_info.json").exists()


@pytest.fixture
def pile_cubes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the example as a module that worker processes find too; its task is known to this test alone."""
    monkeypatch.setattr(record, "_registered", {})
    monkeypatch.delitem(sys.modules, "pile_cubes", raising=False)
    monkeypatch.syspath_prepend(REPOSITORY / "examples")
    return importlib.import_module("pile_cubes")


def test_pile_cubes_is_a_task(pile_cubes: ModuleType) -> None:
    assert registry.get_task("pile_cubes:PileCubes") is pile_cubes.TASK
    assert record.script_of(pile_cubes.TASK).start is pile_cubes.START
    sim = Simulation(pile_cubes.TASK, controller=HoldController(1))
    sim.reset([{"robot": [-3.0, 0.0, 0.0], "object": [0.0, 0.0, 0.3]}])  # the robot topples where it is in nobody's way
    assert not sim.success()[0]
    T = sim.pose("blue")[0]
    for sideways, succeeds in ((0.0, True), (0.035, False)):
        for above, held in ((0.0, succeeds), (0.03, False)):  # m, set down or held up: only what rests is stacked
            sim.set_pose("red", T @ poses.pose([sideways, 0.0, pile_cubes.STACKED + above]))
            if above == 0.0:
                sim.step(command.rest()[None])  # measures what presses on what
            assert sim.success()[0] == held
    sim.close()


@pytest.mark.slow
def test_pile_cubes(pile_cubes: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pile_cubes.main(tmp_path, num_attempts=2)
    printed = capsys.readouterr().out
    assert "R1: 2 of 2 attempts succeeded" in printed and "R3: " in printed


def test_task_files_of_version_0_1_can_be_imported() -> None:
    """Their imports stay, and name what the new ones name."""
    from gym_demohlm import furniture, registry, scene, simulation, task, worlds

    assert task.register_task is registry.register_task  # type: ignore[attr-defined]
    assert worlds.Worlds is simulation.worlds.Worlds
    assert {"add_cube", "add_round_table", "add_shape", "QUARTER_TURNS"} <= set(vars(furniture))
    assert furniture.add_cube is scene.furniture.add_cube
