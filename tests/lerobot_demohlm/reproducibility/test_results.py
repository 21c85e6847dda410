"""Lines of results name the code's commit, wherever the user is."""

import subprocess
from pathlib import Path

import pytest

from gym_demohlm import jsonl
from lerobot_demohlm.reproducibility import results


def test_a_commit_is_the_codes_not_that_of_where_the_user_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = results.commit()
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    monkeypatch.chdir(tmp_path)
    assert results.commit() == here


def test_code_in_an_environment_within_a_repository_has_no_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    installed = tmp_path / ".venv" / "results.py"
    installed.parent.mkdir()
    installed.touch()
    monkeypatch.setattr(results, "__file__", str(installed))
    assert results.commit() == "unknown"


def test_without_git_a_line_is_written_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    results.append_result(tmp_path / "found.jsonl", "a command", {"rate": 1.0})
    assert jsonl.read(tmp_path / "found.jsonl") == [{"rate": 1.0, "command": "a command", "commit": "unknown"}]
