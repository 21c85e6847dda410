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


def test_changed_code_is_marked_and_lines_of_results_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, lines = tmp_path / "package" / "results.py", tmp_path / "results" / "found.jsonl"
    for path in (code, lines):
        path.parent.mkdir()
        path.touch()
    who = ["-c", "user.name=A", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    monkeypatch.setattr(results, "__file__", str(code))
    first = results.commit()
    assert first not in ("", "unknown") and not first.endswith("+")
    lines.write_text("{}\n")
    assert results.commit() == first
    code.write_text("changed\n")
    assert results.commit() == first + "+"


def test_without_git_a_line_is_written_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    results.append_result(tmp_path / "found.jsonl", "a command", {"rate": 1.0})
    assert jsonl.read(tmp_path / "found.jsonl") == [{"rate": 1.0, "command": "a command", "commit": "unknown"}]
