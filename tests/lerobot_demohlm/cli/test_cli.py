"""``demohlm`` explains itself, and answers wrong input with one line, exit code 2 and nothing written."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gym_demohlm.registry import get_task
from lerobot_demohlm import cli
from lerobot_demohlm.demonstrations import demonstration as demonstrations

GENERATE = ["generate", "--task", "LiftBox", "--region", "R1", "--num-attempts", "1"]


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a call."""
    try:
        code = cli.main(arguments)
    except SystemExit as end:  # argparse ends this way
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    for verb in cli.VERBS:
        assert f"  {verb.name} " in out
        assert verb.help in out


@pytest.mark.parametrize("verb", cli.VERBS, ids=lambda verb: verb.name)
def test_every_verb_has_help(verb: cli.Verb, capsys: pytest.CaptureFixture[str]) -> None:
    """Every module can be imported, declares its options, and its example parses."""
    code, out, _ = run(capsys, *verb.name.split(), "--help")
    assert code == 0
    assert f"demohlm {verb.name}" in out
    assert verb.help[1:] in " ".join(out.split())


def test_help_is_quick() -> None:
    """Verbs are listed without the seconds that importing torch and lerobot takes."""
    code = "import sys; from lerobot_demohlm import cli\ntry: cli.main(['--help'])\nexcept SystemExit: pass\n"
    code += "print(sorted({'torch', 'lerobot', 'lerobot_demohlm.demonstrations.demonstration'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1] == "[]"


def test_an_unknown_verb_names_the_known(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "fly")
    assert code == 2
    assert "generate" in err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["--task", "LiftBocks"], "LiftBox"),
        (["--region", "R7"], "R1, R2, R3"),
        (["--num-workers", "0"], "at least 1"),
        (["--num-attempts", "0"], "at least 1"),
        (["--seed", "-1"], "seed"),
        (["--demonstration", "nowhere"], "nowhere"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(
    changes: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, *GENERATE, "--root", str(tmp_path / "data"), *changes)
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_an_existing_root_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (GENERATE, ["record", "--task", "LiftBox"]):
        code, _, err = run(capsys, *arguments, "--root", str(tmp_path))
        assert code == 2
        assert "exists" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("key", "value"), [("task", "PushCube"), ("format_version", 0)])
def test_a_wrong_demonstration_is_refused(
    key: str, value: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "demonstration"
    shutil.copytree(demonstrations.default_root(get_task("LiftBox")), source)
    meta = source / demonstrations.META_PATH
    meta.write_text(json.dumps(json.loads(meta.read_text()) | {key: value}))
    code, _, err = run(capsys, *GENERATE, "--demonstration", str(source), "--root", str(tmp_path / "data"))
    assert code == 2
    assert str(value) in err
    assert not (tmp_path / "data").exists()
    assert not (tmp_path / "data.partial").exists()


def test_segment_shows_the_switch(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "segment", "--task", "LiftBox")
    assert code == 0
    assert "touch box" in out
    assert "its own motion (body)" in out


def test_replay_says_that_every_bit_agrees(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "replay", "--task", "LiftBox")
    assert code == 0
    assert "every bit as recorded" in out
