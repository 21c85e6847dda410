"""The examples and the README's code run as they stand."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import imageio.v3 as iio
import pytest

REPOSITORY = Path(__file__).parent.parent


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


def test_readme_code() -> None:
    snippets = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert snippets
    for snippet in snippets:
        names: dict[str, object] = {}
        exec(compile(snippet, "README.md", "exec"), names)
        names["env"].close()  # type: ignore[attr-defined]
