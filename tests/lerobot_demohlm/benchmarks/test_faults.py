"""Whatever happens to a run, nothing finished is lost, nothing is there twice, and one message says what to do."""

import contextlib
import functools
import importlib
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gym_demohlm import registry
from gym_demohlm.errors import DatasetError
from lerobot_demohlm import cli
from lerobot_demohlm.datasets import facts
from lerobot_demohlm.generation import request, runner
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.run import GenerationRun, failures_root, partial_directory
from tests.helpers.synthetic import make_episode, make_facts


@pytest.fixture(scope="module")
def faults() -> Iterator[ModuleType]:
    """Return the module; its task is known to these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_registered", registry.all_tasks())
        for name in ("faults", "brief_task"):
            patch.delitem(sys.modules, f"lerobot_demohlm.benchmarks.{name}", raising=False)
        yield importlib.import_module("lerobot_demohlm.benchmarks.faults")


def compute(run: GenerationRun) -> None:
    """Make every block that is missing; attempts 2, 5 and 8 fail."""
    for attempts in run.pending_blocks():
        episodes = [make_episode(i, outcome="fell" if i % 3 == 2 else "success", length=4) for i in attempts]
        write_block(run.directory, run.facts, attempts, episodes)


def opened(root: Path) -> GenerationRun:
    return GenerationRun.open(root, "user/name", make_facts(keep_failures=True))


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that has all its blocks."""
    run = opened(tmp_path_factory.mktemp("begun") / "data")
    compute(run)
    run.close()
    return run.directory


@pytest.fixture(scope="module")
def reference(begun: Path, faults: ModuleType) -> dict[str, str]:
    """Return the files that such a run ends in: data, failures."""
    root = begun.with_name("reference")
    shutil.copytree(begun, partial_directory(root))
    opened(root).finish()
    return {where.name: faults.digest(where) for where in (root, failures_root(root))}


def ended(root: Path, faults: ModuleType) -> dict[str, str]:
    """Go on with a run to its end and return its files."""
    run = opened(root)
    compute(run)
    run.finish()
    assert not run.directory.exists()
    named = {root: "reference", failures_root(root): "reference-failures"}
    return {name: faults.digest(where) for where, name in named.items()}


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "flipped": flip,
    "cut": lambda path: os.truncate(path, path.stat().st_size - 3),
    "emptied": lambda path: path.write_bytes(b""),
    "removed": lambda path: path.unlink(),
    "joined": lambda path: path.with_name("another").write_text("file"),
}
FILES = ("block.json", "attempts.jsonl", "episodes/data/chunk-000/file-000.parquet", "failures/meta/info.json")


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_block_is_made_again(
    damage: str,
    file: str,
    tmp_path: Path,
    begun: Path,
    reference: dict[str, str],
    faults: ModuleType,
    caplog: pytest.LogCaptureFixture,
) -> None:
    root = tmp_path / "data"
    shutil.copytree(begun, partial_directory(root))
    DAMAGES[damage](partial_directory(root) / "blocks" / "0000004" / file)
    run = opened(root)
    assert list(run.pending_blocks()) == [range(4, 8)]
    assert len(caplog.messages) == 1 and "0000004, damaged" in caplog.text and "again" in caplog.text
    run.close()
    assert ended(root, faults) == reference


def test_a_block_that_is_damaged_during_the_run_is_never_merged(tmp_path: Path, begun: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(begun, partial_directory(root))
    run = opened(root)
    flip(run.directory / "blocks" / "0000004" / FILES[2])
    with pytest.raises(DatasetError, match=r"0000004, damaged \(episodes/data/.*again"):
        run.finish()
    assert not root.exists()


@pytest.mark.parametrize("step", range(3))
def test_a_run_that_is_killed_while_it_hands_over_goes_on(
    step: int,
    tmp_path: Path,
    begun: Path,
    reference: dict[str, str],
    faults: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At each of the renames that end a run."""
    root = tmp_path / "data"
    shutil.copytree(begun, partial_directory(root))
    run = opened(root)
    rename, stop = Path.rename, ("finished", "data-failures", "data")[step]

    def rename_or_stop(path: Path, target: Path) -> Path:
        if target.name == stop:
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename_or_stop)
        with pytest.raises(KeyboardInterrupt):
            run.finish()
    run.close()
    assert not root.exists()
    assert ended(root, faults) == reference


@pytest.fixture(scope="module")
def merged(begun: Path) -> Path:
    """Return a run whose datasets are merged; one of its blocks will do, to be removed."""
    root = begun.with_name("merging")
    shutil.copytree(begun, partial_directory(root))
    run = opened(root)
    run._merge(None).rename(run._finished)
    run.close()
    for block in sorted((run.directory / "blocks").iterdir())[1:]:
        shutil.rmtree(block)
    return run.directory


def test_a_run_that_is_killed_while_it_tidies_up_goes_on_or_is_over(
    tmp_path: Path, merged: Path, reference: dict[str, str], faults: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before each rename and each removal: no call but the same one goes on, and nothing but the datasets stays."""
    calls = {name: getattr(os, name) for name in ("rename", "unlink", "rmdir")}
    resumed = []
    for step in itertools.count():
        root, left = tmp_path / str(step) / "data", iter(range(step))
        shutil.copytree(merged, partial_directory(root))
        run = opened(root)

        def call_or_stop(name: str, *args: Any, left: Iterator[int] = left, **options: Any) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            calls[name](*args, **options)

        with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
            for name in calls:
                patch.setattr(os, name, functools.partial(call_or_stop, name))
            run.finish()
        run.close()
        with pytest.raises(DatasetError, match=r"which exists|begun with num_attempts=10"):
            GenerationRun.open(root, "user/name", make_facts(keep_failures=True, num_attempts=20))
        if partial_directory(root).exists():
            opened(root).finish()
            resumed.append(step)
        with pytest.raises(DatasetError, match="which exists"):
            opened(root)
        assert [place.name for place in sorted(root.parent.iterdir())] == ["data", "data-failures"]
        assert [faults.digest(place) for place in (root, failures_root(root))] == list(reference.values())
        if next(left, None) is not None:
            break  # it was not stopped
    assert resumed == [0, 1, 2] and step > 20


def test_two_runs_on_one_root(tmp_path: Path) -> None:
    first = opened(tmp_path / "data")
    with pytest.raises(DatasetError, match=rf"process {os.getpid()} .* at work.*one run at a time"):
        opened(tmp_path / "data")
    first.close()
    opened(tmp_path / "data").close()


def test_a_lock_dies_with_its_process(tmp_path: Path) -> None:
    opened(tmp_path / "data").close()
    code = (
        "import sys; from pathlib import Path; from lerobot_demohlm.reproducibility.run_lock import RunLock\n"
        "lock = RunLock(Path(sys.argv[1])); print('locked', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, partial_directory(tmp_path / "data")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"locked\n"
        with pytest.raises(DatasetError, match=rf"process {holder.pid} .* at work"):
            opened(tmp_path / "data")
        holder.send_signal(signal.SIGKILL)
    opened(tmp_path / "data").close()


def test_resume_begins_nothing(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="without a run"):
        GenerationRun.open(tmp_path / "data", "user/name", make_facts(), resume=True)
    assert list(tmp_path.iterdir()) == []
    GenerationRun.open(tmp_path / "data", "user/name", make_facts()).close()
    GenerationRun.open(tmp_path / "data", "user/name", make_facts(), resume=True).close()


def test_ctrl_c_says_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(run: GenerationRun, *_: object) -> None:
        attempts = next(run.pending_blocks())
        write_block(run.directory, run.facts, attempts, [make_episode(i, outcome="fell", length=0) for i in attempts])
        assert run.is_done(attempts)
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "make_blocks", interrupted)
    command = [
        "generate",
        "--task",
        "LiftBox",
        "--num-attempts",
        str(2 * request.BLOCK_SIZE),
        "--root",
        str(tmp_path / "data"),
    ]
    assert cli.main(command) == cli.INTERRUPTED
    last = capsys.readouterr().err.splitlines()[-1]
    kept = f"{request.BLOCK_SIZE} attempts are kept in {tmp_path / 'data.partial'}"
    assert last.startswith(f"interrupted: {kept}; the same command")
    assert len(list((tmp_path / "data.partial" / "blocks").iterdir())) == 1


def test_ctrl_c_during_the_tidying_up_says_where_the_dataset_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(run: GenerationRun) -> None:
        run.directory.rename(run.root)
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "make_blocks", lambda *_: None)
    monkeypatch.setattr(GenerationRun, "finish", interrupted)
    command = ["generate", "--task", "LiftBox", "--num-attempts", "1", "--root", str(tmp_path / "data")]
    assert cli.main(command) == cli.INTERRUPTED
    assert f"interrupted: the dataset is whole, in {tmp_path / 'data'}" in capsys.readouterr().err.splitlines()[-1]


def test_the_bar_does_not_mind_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rng, now = random.Random(0), time.time()
    monkeypatch.setattr(time, "time", lambda: now + rng.uniform(-1e6, 1e6))
    run = opened(tmp_path / "data")
    with runner._Progress(run, shown=True) as progress:
        for attempts in run.pending_blocks():
            episodes = [make_episode(i, outcome="fell", length=0) for i in attempts]
            write_block(run.directory, run.facts, attempts, episodes)
            assert run.is_done(attempts)
            progress.update()
            assert f"{run.num_attempts}/10" in capsys.readouterr().err


@contextlib.contextmanager
def mounted(faults: ModuleType, place: Path, size: int) -> Iterator[Callable[[str], None]]:
    """Mount a small disk; skips where only root may, and for no other reason."""
    with contextlib.ExitStack() as stack:
        try:
            remount = stack.enter_context(faults.mounted(place, size))
        except PermissionError as error:
            pytest.skip(str(error))
        yield remount


def test_a_full_disk_is_said_and_leaves_nothing_half_written(tmp_path: Path, faults: ModuleType) -> None:
    episodes = [make_episode(i, length=100) for i in range(4)]
    with mounted(faults, tmp_path / "disk", 64 * 1024) as remount:
        run = opened(tmp_path / "disk" / "data")
        with pytest.raises(DatasetError, match=r"No space left on device.*free space"):
            write_block(run.directory, run.facts, range(4), episodes)
        assert list((run.directory / "blocks").iterdir()) == []
        remount("size=1m")
        write_block(run.directory, run.facts, range(4), episodes)
        assert run.is_done(range(4))
        run.close()


def test_a_root_that_cannot_be_written_is_said(tmp_path: Path, faults: ModuleType) -> None:
    with mounted(faults, tmp_path / "disk", 2**20) as remount:
        opened(tmp_path / "disk" / "begun").close()
        remount("ro")
        for name in ("begun", "new"):
            with pytest.raises(DatasetError, match=r"Read-only file system at .*another --root"):
                opened(tmp_path / "disk" / name)
        assert [path.name for path in (tmp_path / "disk").iterdir()] == ["begun.partial"]


def test_no_attempt_is_there_twice(tmp_path: Path, begun: Path) -> None:
    """Also where a worker of a run that was killed has made a block that another makes as well."""
    root = tmp_path / "data"
    shutil.copytree(begun, partial_directory(root))
    run = opened(root)
    write_block(run.directory, run.facts, range(4), [make_episode(i, outcome="fell", length=0) for i in range(4)])
    run.finish()
    assert [record["attempt"] for record in facts.read_attempts(root)] == list(range(10))
    assert facts.read_facts(root)["successes"] == 7  # what was there first stays


@pytest.fixture(scope="module")
def bench(faults: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return faults.Bench(tmp_path_factory.mktemp("bench"), num_attempts=4 * request.BLOCK_SIZE)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("fault", "times"),
    [
        ("kill", 6),
        ("keep_killing_workers", 1),
        ("interrupt", 2),
        ("fill_the_disk", 2),
        ("forbid_writing", 2),
        ("damage_blocks", 2),
        ("damage_demonstration", 4),
        ("run_twice", 1),
        ("shake_the_clock", 1),
    ],
)
def test_faults_of_whole_runs(fault: str, times: int, faults: ModuleType, bench: Any) -> None:
    tally = getattr(faults, fault)(bench, times)
    if tally.note and not tally.tried:
        pytest.skip(tally.note)
    assert tally.tried >= times
    assert (tally.survived, tally.lost) == (tally.tried, 0)
