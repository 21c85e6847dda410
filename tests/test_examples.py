"""The examples and the README's code run as they stand."""

import importlib
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import imageio.v3 as iio
import pytest

from gym_demohlm import poses, task
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
def stack_cube(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the example as a module that worker processes find too; its task is known to this test alone."""
    monkeypatch.setattr(task, "_registered", task.all_tasks())
    monkeypatch.setattr(record, "_registered", {})
    monkeypatch.delitem(sys.modules, "stack_cube", raising=False)
    monkeypatch.syspath_prepend(REPOSITORY / "examples")
    return importlib.import_module("stack_cube")


def test_stack_cube_is_a_task(stack_cube: ModuleType) -> None:
    assert task.get_task("stack_cube:StackCube") is stack_cube.TASK
    assert record.script_of(stack_cube.TASK).start is stack_cube.START
    sim = Simulation(stack_cube.TASK, controller=HoldController(1))
    sim.reset([{"robot": [-3.0, 0.0, 0.0], "object": [0.0, 0.0, 0.3]}])  # the robot topples where it is in nobody's way
    assert not sim.success()[0]
    T = sim.pose("blue")[0]
    for sideways, succeeds in ((0.0, True), (0.035, False)):
        for above, held in ((0.0, succeeds), (0.03, False)):  # m, set down or held up: only what rests is stacked
            sim.set_pose("red", T @ poses.pose([sideways, 0.0, stack_cube.STACKED + above]))
            if above == 0.0:
                sim.step(command.rest()[None])  # measures what presses on what
            assert sim.success()[0] == held
    sim.close()


@pytest.mark.slow
def test_stack_cube(stack_cube: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stack_cube.main(tmp_path, num_attempts=2)
    printed = capsys.readouterr().out
    assert "R1: 2 of 2 attempts succeeded" in printed and "R3: " in printed


def test_readme_code() -> None:
    snippets = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert snippets
    for snippet in snippets:
        names: dict[str, object] = {}
        exec(compile(snippet, "README.md", "exec"), names)
        names["env"].close()  # type: ignore[attr-defined]
