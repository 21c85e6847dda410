"""``demohlm`` explains itself, and answers wrong input with one line, exit code 2 and nothing written."""

import csv
import errno
import importlib
import importlib.util
import json
import logging
import math
import os
import shutil
import subprocess
import sys
import types
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

from gym_demohlm.perception.pose_server import BACKENDS
from gym_demohlm.perception.settings import MASKS, SOURCES
from gym_demohlm.registry import get_task
from gym_demohlm.wbc.evaluation.contest import PROTOCOLS
from gym_demohlm.wbc.evaluation.peer import PEERS
from lerobot_demohlm import cli
from lerobot_demohlm.cli import choices, completion, reference
from lerobot_demohlm.cli.parsing import Flag, flags_of, parse, spelled
from lerobot_demohlm.cli.verbs import GROUPS, VERBS, Verb
from lerobot_demohlm.demonstrations import demonstration as demonstrations

SURFACE = Path(__file__).with_name("surface.tsv")
RESULTS = Path(__file__).parents[3] / "results"
"""Flags and defaults of version 0.1, before tyro, which scripts of users rely on."""
HEAVY = ("torch", "lerobot", "datasets", "pyarrow", "matplotlib", "jinja2", "rsl_rl", "placo")
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
    for verb in VERBS:
        assert f"  {verb.name} " in out
        assert verb.help in out


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_every_verb_has_help(verb: Verb, capsys: pytest.CaptureFixture[str]) -> None:
    """Every module can be imported, declares its options, and its example parses."""
    code, out, _ = run(capsys, *verb.name.split(), "--help")
    assert code == 0
    assert f"demohlm {verb.name}" in out
    assert verb.help[1:] in " ".join(out.split())


def options_of(verb: Verb) -> type:
    """Return the dataclass of a verb."""
    return importlib.import_module(verb.module).Options


def written(value: object) -> str:
    """Return a default as the table of the surface has it."""
    if value is None or value is False:
        return ""
    return " ".join(map(str, value)) if isinstance(value, tuple) else "inf" if value == math.inf else str(value)


def surface() -> Iterator[tuple[str, dict[str, str]]]:
    """Yield verb and line of each flag of version 0.1."""
    with SURFACE.open() as file:
        for line in csv.DictReader(file, delimiter="\t"):
            yield line.pop("verb"), line


def test_help_names_the_groups(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "--help")
    assert code == 0
    headings = [line[:-1] for line in out.splitlines() if line.endswith(":")]
    assert headings == list(GROUPS)
    assert {verb.group for verb in VERBS} == set(GROUPS)


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_help_has_every_option_with_its_doc_and_default(verb: Verb, capsys: pytest.CaptureFixture[str]) -> None:
    """What ``flags_of`` lists, for the reference and for messages, is what tyro makes of the dataclass."""
    _, out, _ = run(capsys, *verb.words, "--help")
    shown = " ".join(out.replace("│", " ").split())
    for flag in flags_of(options_of(verb)):
        assert flag.help, f"{flag.name} of {verb.name} has no attribute doc"
        assert flag.help in shown
        assert f"{flag.name if flag.name.startswith('-') else flag.name.upper()} " in shown
        if flag.fallback is not None:
            assert f"(default: {flag.fallback})" in shown
        elif flag.required:
            assert "(required)" in shown
        elif flag.value:
            assert f"(default: {written(flag.default)})" in shown
    assert shown.count("--") >= len(list(flags_of(options_of(verb))))


def test_every_flag_of_before_is_there() -> None:
    """All flags of version 0.1 are spelled as they were and have the same defaults."""
    flags = {verb.name: {flag.name: flag for flag in flags_of(options_of(verb))} for verb in VERBS}
    count = 0
    for verb, line in surface():
        flag: Flag = flags[verb][line["flag"]]
        assert ("required" if flag.required else written(flag.default)) == line["default"], (verb, line)
        assert (line["values"] == "nothing") == (flag.value == ""), (verb, line)
        assert (line["values"] == "several") == flag.several, (verb, line)
        assert set(filter(None, line["choices"].split("|"))) <= set(flag.value.split("|")), (verb, line)
        count += 1
    assert count == 174


@pytest.mark.parametrize("name", ["benchmark variation", "benchmark feedback", "benchmark perturbed"])
def test_what_need_not_be_given_is_left_out(name: str) -> None:
    """Also options of which several values may follow."""
    verb = next(verb for verb in VERBS if verb.name == name)
    assert parse(options_of(verb), verb, []) == options_of(verb)()


def test_help_is_quick() -> None:
    """Neither the verbs nor the options of any of them take the seconds that importing torch and lerobot takes."""
    code = (
        "import sys, contextlib, io\n"
        "from lerobot_demohlm import cli\n"
        "from lerobot_demohlm.cli.verbs import VERBS\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        "    codes = [cli.main([*words, '--help']) for words in [(), *(verb.words for verb in VERBS)]]\n"
        f"print(codes == [0] * (1 + len(VERBS)), sorted(set({HEAVY!r}) & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1] == "True []"


def test_choices_are_those_of_the_library() -> None:
    from lerobot_demohlm.experiments.plan import TABLES
    from lerobot_demohlm.experiments.variants import VARIANTS
    from lerobot_demohlm.policies.presets import NAMES, POLICIES

    for chosen, known in (
        (choices.Policy, POLICIES),
        (choices.Preset, NAMES),
        (choices.Table, TABLES),
        (choices.Variant, tuple(VARIANTS)),
        (choices.Peer, tuple(PEERS)),
        (choices.Protocol, tuple(PROTOCOLS)),
        (choices.Perception, SOURCES),
        (choices.Masks, MASKS),
        (choices.Backend, tuple(BACKENDS)),
    ):
        assert typing.get_args(chosen) == known


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "no verb; expected one of adopt-controller, "),
        ("fly", "expected one of adopt-controller, "),
        ("generat", "did you mean 'generate'?"),
        ("benchmark reech", "did you mean 'reach'?"),
        ("benchmark controller pear", "did you mean 'peer'?"),
        ("train --root x --polcy act", "did you mean '--policy'?"),
        ("train --root x --policy acd", "'acd'"),
        ("train --root x --seed one", "--seed"),
        ("train --root x --seed", "--seed"),
        ("train --root x more", "more"),
        ("train --policy act", "got no --root or --task"),
        ("train --root x --task y", "got --root and --task"),
        ("record --root x", "got no --task; expected --task TEXT"),
        ("lint-task", "got no TASK"),
        ("reproduce --table main --tasks", "no value after --tasks"),
        ("benchmark controller --peer holosoma", "`demohlm benchmark controller peer`"),
        ("benchmark controller --trade-off docs", "`demohlm benchmark controller trade-off`"),
        ("--print-completion fish", "bash, zsh"),
    ],
)
def test_a_wrong_call_is_one_line(line: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, *line.split())
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert not set("╭│╰") & set(err)


def test_former_flags_have_become_verbs() -> None:
    """Whatever verb a former flag names is there, and its option too."""
    verbs = {verb.name: verb for verb in VERBS}
    moved = {flag: target for verb in VERBS for flag, target in verb.moved.items()}
    assert len(moved) == 7
    for target in moved.values():
        name, _, option = target.partition(" --")
        assert not option or f"--{option}" in {flag.name for flag in flags_of(options_of(verbs[name]))}


def test_values_arrive(capsys: pytest.CaptureFixture[str]) -> None:
    verbs = {verb.name: verb for verb in VERBS}
    words = "--table main --tasks LiftBox PushCube --sizes 100 --seeds 0 1 --budget-hours=0.5 --dry-run --num_workers 2"
    found = parse(options_of(verbs["reproduce"]), verbs["reproduce"], words.split())
    assert (found.tasks, found.sizes, found.seeds) == (("LiftBox", "PushCube"), (100,), (0, 1))
    assert (found.budget_hours, found.dry_run, found.num_workers) == (0.5, True, 2)
    assert found.root == Path("outputs/experiments")
    said = spelled("reproduce", found, leave_out=("num_workers", "budget_hours", "dry_run"))
    assert said == "demohlm reproduce --table main --tasks LiftBox PushCube --sizes 100 --seeds 0 1"
    found = parse(options_of(verbs["lint-task"]), verbs["lint-task"], "LiftBox --num-still 1".split())
    assert spelled("lint-task", found) == "demohlm lint-task LiftBox --num-still 1"


def call(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Have ``demohlm results`` end with an error."""

    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(importlib.import_module("lerobot_demohlm.cli.results"), "run", fail)


def test_ctrl_c_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    call(monkeypatch, KeyboardInterrupt("2 attempts are kept"))
    assert run(capsys, "results") == (130, "", "interrupted: 2 attempts are kept\n")


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    call(monkeypatch, ModuleNotFoundError("No module named 'rsl_rl'", name="rsl_rl.runners"))
    code, _, err = run(capsys, "results")
    assert code == 2
    assert "uv sync --extra wbc" in err
    call(monkeypatch, ModuleNotFoundError("No module named 'elsewhere'", name="elsewhere"))
    with pytest.raises(ModuleNotFoundError):
        cli.main(["results"])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("demohlm gen", {"generate"}),
        ("demohlm generate --num-", {"--num-attempts", "--num-episodes", "--num-workers"}),
        ("demohlm train --policy ", {"mlp", "act", "diffusion"}),
        ("demohlm benchmark rea", {"reach"}),
        ("demohlm benchmark --rou", {"--rounds"}),
        ("demohlm benchmark controller tr", {"trade-off"}),
        ("demohlm benchmark controller peer --name ", {"holosoma", "holosoma-ppo"}),
    ],
)
def test_bash_completes(line: str, expected: set[str], scripts: dict[str, Path]) -> None:
    if shutil.which("bash") is None:
        pytest.skip("no bash on this machine")
    words = " ".join(f"'{word}'" for word in line.split(" "))
    code = [
        f"source {scripts['bash']}",
        f"COMP_WORDS=({words}) COMP_LINE='{line}'",
        "COMP_CWORD=$((${#COMP_WORDS[@]} - 1)) COMP_POINT=${#COMP_LINE}",
        "$(complete -p demohlm | cut -d ' ' -f 3)",  # the function that completes
        "printf '%s\\n' \"${COMPREPLY[@]}\"",
    ]
    found = subprocess.run(["bash", "-c", "\n".join(code)], capture_output=True, text=True, check=True).stdout
    assert set(found.split()) == expected


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return files with the completion scripts."""
    folder = tmp_path_factory.mktemp("completion")
    files = {shell: folder / shell for shell in cli.SHELLS}
    for shell, file in files.items():
        file.write_text(completion.script(shell))
    return files


def test_completion_is_printed(scripts: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--print-completion", "zsh"], ["--print-completion=zsh"]):
        assert run(capsys, *words) == (0, scripts["zsh"].read_text() + "\n", "")
    assert scripts["zsh"].read_text().startswith("#compdef demohlm")


def test_the_reference_is_up_to_date(tmp_path: Path) -> None:
    file = Path(__file__).parents[3] / "docs/cli.md"
    assert file.read_text() == reference.reference(), "run `python -m lerobot_demohlm.cli.reference docs/cli.md`"
    for verb in VERBS:
        assert f"### demohlm {verb.name}\n" in file.read_text()
    copy = tmp_path / "cli.md"
    assert reference.main(reference.Options(path=copy, check=True)) == 1
    assert reference.main(reference.Options(path=copy)) == 0
    assert reference.main(reference.Options(path=copy, check=True)) == 0


def test_a_long_warning_is_dropped_and_others_stay(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """LeRobot's own code warns, with and without torchcodec installed."""
    from lerobot.utils import import_utils

    logger = logging.getLogger(import_utils.__name__)
    before = list(logger.filters)
    broken = types.SimpleNamespace(
        util=types.SimpleNamespace(find_spec=lambda name: name), import_module=lambda name: importlib.import_module("!")
    )
    absent = types.SimpleNamespace(util=types.SimpleNamespace(find_spec=lambda name: None))
    try:
        logger.filters[:] = []
        for fake in (broken, absent):
            monkeypatch.setattr(import_utils, "importlib", fake)
            assert import_utils.get_safe_default_video_backend() == "pyav"
        assert len(caplog.records) == 2
        caplog.clear()
        assert run(capsys, "--help")[0] == 0
        for fake in (broken, absent):
            monkeypatch.setattr(import_utils, "importlib", fake)
            assert import_utils.get_safe_default_video_backend() == "pyav"
        logger.warning("another warning")
        assert [record.getMessage() for record in caplog.records] == ["another warning"]
    finally:
        logger.filters[:] = before


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


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("segment --task LiftBox --write-corrections", "copy it, and give --root"),
        ("segment --task LiftBox --figure seg.txt", "ends in .png or .svg"),
        ("record --task LiftBox --teleop web --port 99999 --root new", "0 to 65535"),
        ("record --task LiftBox --scale -1 --root new", "0.1 to 10"),
        ("results --results nowhere --output new.md", "no folder nowhere"),
        ("generate --task LiftBox --num-attempts 1 --repo-id a:b --root new", "repo id 'a:b'"),
        ("card --root new --repo-id box", "expected user/name"),
        ("tune-controller --output new.npz --gait recovry_s=4", "did you mean 'recovery_s'"),
        ("tune-controller --output new.npz --gait recovery_s=-4", "correct --gait"),
        ("reproduce --table regions --sizes 7 --dry-run", "leave --sizes out"),
        ("evaluate --policy new --task LiftBox --perception exact --latency-s 0.05", "a multiple of 0.1 s"),
        ("evaluate --policy new --task LiftBox --seed 99999999999999999999", "seeds from 0 to 9223372036854775807"),
        (f"results --results {RESULTS} --pages missing.md", "no file missing.md"),
        (f"results --results {RESULTS} --output {RESULTS}/speed.jsonl/new.md", "speed.jsonl"),
    ],
)
def test_wrong_values_are_one_line_and_write_nothing(
    line: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *line.split())
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1
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


@pytest.mark.parametrize(
    ("number", "name", "said"),
    [
        (errno.ENOSPC, None, "error: got a file (No space left on device); free some space"),
        (errno.ENOSPC, "a.md", "error: got a.md (No space left on device); free some space"),
        (errno.EROFS, "a.md", "error: got a.md (Read-only file system); check the paths of the command"),
        (errno.EIO, "a.md", None),
        (errno.EACCES, None, None),
    ],
)
def test_what_a_disk_refuses_ends_in_one_line(
    number: int,
    name: str | None,
    said: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(_: list[str]) -> int:
        raise OSError(number, os.strerror(number), name)

    monkeypatch.setattr(cli, "_run", fail)
    if said is None:
        with pytest.raises(OSError, match=os.strerror(number)):
            cli.main(["results"])
    else:
        assert run(capsys, "results") == (2, "", said + "\n")
