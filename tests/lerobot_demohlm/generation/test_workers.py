"""A block whose worker dies is made by another; a worker that keeps dying ends the run and says why."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError, DemoHLMError, NoSuccessError, UnknownNameError
from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations import demonstration
from lerobot_demohlm.generation import run as run_module
from lerobot_demohlm.generation.block import write_block
from lerobot_demohlm.generation.request import GenerationRequest
from lerobot_demohlm.generation.run import GenerationRun
from lerobot_demohlm.generation.runner import BlockMaker, generate, make_blocks
from lerobot_demohlm.generation.workers import Done, Make, ProcessWorkers
from lerobot_demohlm.reproducibility import provenance
from tests.helpers import makes, outside
from tests.helpers.paths import REPOSITORY
from tests.helpers.synthetic import make_episode, make_facts


class ScriptedWorkers:
    """Workers in this process that make blocks of failures in turn; some blocks kill them.

    Args:
        run: Whose blocks they make.
        num_workers: Blocks at a time.
        deaths: How often a block kills its worker, by its first attempt.
    """

    def __init__(self, run: GenerationRun, num_workers: int, deaths: dict[int, int] | None = None) -> None:
        self.run, self.num_workers, self.deaths = run, num_workers, Counter(deaths or {})
        self.working: list[range] = []
        self.submitted: list[int] = []

    @property
    def free(self) -> int:
        return self.num_workers - len(self.working)

    def submit(self, attempts: range) -> None:
        self.working.append(attempts)
        self.submitted.append(attempts.start)

    def wait(self) -> list[Done]:
        attempts = self.working.pop(0)
        if self.deaths[attempts.start] > 0:
            self.deaths[attempts.start] -= 1
            return [Done(attempts=attempts, death="killed by SIGKILL")]
        episodes = [make_episode(index, outcome="fell", length=0) for index in attempts]
        write_block(self.run.directory, self.run.facts, attempts, episodes)
        return [Done(attempts=attempts)]


@pytest.fixture
def run(tmp_path: Path) -> GenerationRun:
    return GenerationRun.open(tmp_path / "data", "user/name", make_facts())


@pytest.mark.parametrize("num_workers", [1, 2, 5])
def test_a_block_whose_worker_dies_is_made_again(run: GenerationRun, num_workers: int) -> None:
    workers = ScriptedWorkers(run, num_workers, {0: 1, 4: 2})
    make_blocks(run, workers)
    assert Counter(workers.submitted) == {0: 2, 4: 3, 8: 1}
    assert [record["attempt"] for record in run.records()] == list(range(10))


def test_a_worker_that_keeps_dying_ends_the_run_with_its_reason(run: GenerationRun) -> None:
    with pytest.raises(DemoHLMError, match=r"3 workers that died at attempts 4 to 7.*killed by SIGKILL.*goes on"):
        make_blocks(run, ScriptedWorkers(run, 2, {4: 3}))
    assert run.num_attempts == 6  # what the others made is kept


def test_a_block_that_cannot_be_read_is_made_again(
    run: GenerationRun, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    workers = ScriptedWorkers(run, 1)
    wait, spoiled = workers.wait, []

    def spoil() -> list[Done]:
        done = wait()
        if not spoiled:
            path = run.directory / "blocks" / f"{done[0].attempts.start:07d}" / "attempts.jsonl"
            path.write_bytes(path.read_bytes()[:-5])
            spoiled.append(path)
        return done

    monkeypatch.setattr(workers, "wait", spoil)
    make_blocks(run, workers)
    assert workers.submitted == [0, 0, 4, 8]
    assert "attempts.jsonl" in caplog.text and "damaged" in caplog.text


def test_no_more_blocks_are_begun_than_the_target_needs(tmp_path: Path) -> None:
    """Block 0 is slow; the others have met the target behind it, so nobody runs further ahead."""
    facts = make_facts(num_attempts=None, num_episodes=8)
    run = GenerationRun.open(tmp_path / "data", "user/name", facts)
    pending = run.pending_blocks()
    first = next(pending)
    for attempts in pending:
        episodes = [make_episode(index, length=3) for index in attempts]
        write_block(run.directory, facts, attempts, episodes)
        assert run.is_done(attempts)
    assert (first, run.num_attempts) == (range(4), 8)
    assert not run.target_met()
    assert list(GenerationRun.pending_blocks(run)) == [first]


def test_a_run_without_a_success_gives_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run with a target of successes would never end otherwise."""
    monkeypatch.setattr(run_module, "HOPELESS_ATTEMPTS", 8)
    facts = make_facts(num_attempts=None, num_episodes=8)
    run = GenerationRun.open(tmp_path / "data", "user/name", facts)
    for attempts in run.pending_blocks():
        episodes = [make_episode(index, length=3, outcome="dropped") for index in attempts]
        write_block(run.directory, facts, attempts, episodes)
    assert run.target_met() and run.num_attempts == 8
    with pytest.raises(NoSuccessError, match=r"no success in 8 attempts \(8 dropped"):
        run.finish()


def finish(workers: ProcessWorkers, blocks: list[range]) -> list[Done]:
    """Have blocks made; return what became of them in the order in which it became known."""
    done: list[Done] = []
    with contextlib.closing(workers):
        for attempts in blocks:
            while workers.free == 0:
                done += workers.wait()
            workers.submit(attempts)
        while len(done) < len(blocks):
            done += workers.wait()
    return done


def processes(make: Make, directory: Path, num_workers: int = 1) -> ProcessWorkers:
    (directory / "blocks").mkdir()
    return ProcessWorkers(make, directory, num_workers)


def test_processes_share_the_blocks(tmp_path: Path) -> None:
    blocks = [range(start, start + 4) for start in range(0, 24, 4)]
    done = finish(processes(makes.write, tmp_path, 2), blocks)
    assert sorted(entry.attempts.start for entry in done) == [block.start for block in blocks]
    assert all(entry.death is None for entry in done)
    assert len(list((tmp_path / "blocks").iterdir())) == 6


def test_the_death_of_a_process_is_reported_and_another_takes_over(tmp_path: Path) -> None:
    done = finish(processes(makes.die_once, tmp_path), [range(4), range(4), range(4, 8)])
    assert [entry.death for entry in done] == ["killed by SIGKILL, often for want of memory", None, done[0].death]


def test_errors_of_processes_arrive_whole(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="got attempts 8; expected others; leave") as caught:
        finish(processes(makes.fail, tmp_path), [range(8, 12)])
    assert caught.value.expected == "others"
    with pytest.raises(RuntimeError, match=r"attempts 8 to 11:[^$]*stumble[^$]*ZeroDivisionError"):
        finish(ProcessWorkers(makes.stumble, tmp_path, 1), [range(8, 12)])


def test_processes_end_with_their_parent_and_leave_ctrl_c_to_it(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from tests.helpers import makes\n"
        "from lerobot_demohlm.generation.workers import ProcessWorkers\n"
        "if __name__ == '__main__':\n"
        "    workers = ProcessWorkers(makes.take_long, Path(sys.argv[1]), 2)\n"
        "    workers.submit(range(1)); workers.submit(range(1, 2)); workers.wait()\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), *sys.path])}
    process = subprocess.Popen([sys.executable, script, tmp_path], env=environment, start_new_session=True)
    files = [tmp_path / "pid-0", tmp_path / "pid-1"]
    deadline = time.monotonic() + 120
    while not all(file.exists() and file.read_text() for file in files):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    pids = [int(file.read_text()) for file in files]
    for pid in pids:
        os.kill(pid, signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None and all(_lives(pid) for pid in pids)
    process.kill()
    process.wait()
    while any(_lives(pid) for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_worker_of_another_installation_is_refused(tmp_path: Path) -> None:
    facts = make_facts(versions=make_facts().versions | {"mujoco": "2.0"})
    lift_box = demonstration.load(task=get_task("LiftBox"))
    maker = BlockMaker(facts=facts, demonstration=lift_box, task_module=get_task("LiftBox").module)
    with pytest.raises(DatasetError, match=r"a worker with mujoco 3.*mujoco 2\.0"):
        maker(tmp_path, range(4))


@pytest.mark.parametrize("changed", ["code", "controller"])
def test_a_worker_with_other_code_or_another_controller_is_refused(
    changed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after an update of the package in the midst of a run, when a worker dies and another takes its place."""
    facts = make_facts(controller_hash=controllers.load().hash if changed == "code" else "0" * 64)
    lift_box = demonstration.load(task=get_task("LiftBox"))
    maker = BlockMaker(facts=facts, demonstration=lift_box, task_module=get_task("LiftBox").module)
    if changed == "code":
        monkeypatch.setattr(provenance, "generator_hash", lambda: "other")
    with pytest.raises(DatasetError, match=f"a worker with {changed} "):
        maker(tmp_path, range(4))


def test_a_worker_with_another_file_of_the_task_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on another machine, or where the file was edited before a worker took the place of one that had died."""
    monkeypatch.syspath_prepend(tmp_path)
    outside.bring_task(tmp_path, 0.3)
    facts = make_facts(task=outside.NAME, controller_hash=controllers.load().hash)
    lift_box = demonstration.load(task=get_task("LiftBox"))
    maker = BlockMaker(facts=facts, demonstration=lift_box, task_module=outside.MODULE)
    outside.bring_task(tmp_path, 0.2)
    with pytest.raises(DatasetError, match="a worker with code "):
        maker(tmp_path, range(4))


def test_an_edited_task_from_outside_does_not_go_on_with_its_old_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    facts = make_facts(task=outside.NAME)

    def kept() -> int:
        run = GenerationRun.open(tmp_path / "data", "user/name", facts)
        run.close()
        return run.num_attempts

    outside.bring_task(tmp_path, 0.3)
    run = GenerationRun.open(tmp_path / "data", "user/name", facts)
    write_block(run.directory, facts, range(4), [make_episode(i, outcome="fell", length=0) for i in range(4)])
    run.close()
    outside.bring_task(tmp_path, 0.2)
    with pytest.raises(DatasetError, match=r"begun by another version of the file of FromOutside.*another --root"):
        kept()
    outside.bring_task(tmp_path, 0.3)
    assert kept() == 4


def test_a_run_of_the_packages_own_task_notes_no_file(tmp_path: Path) -> None:
    """So what was begun before files were noted goes on."""
    run = GenerationRun.open(tmp_path / "data", "user/name", make_facts())
    run.close()
    begun = json.loads((run.directory / "run.json").read_text())
    assert begun.keys() == {*make_facts().content(), "code_hash", "generator_hash"}


def test_an_unknown_backend_is_refused(tmp_path: Path) -> None:
    request = GenerationRequest(task="LiftBox", region="R1", seed=5, root=tmp_path / "data", num_attempts=1)
    with pytest.raises(UnknownNameError, match="backend"):
        generate(replace(request, backend="process"))  # pyright: ignore[reportArgumentType]


def _lives(pid: int) -> bool:
    with contextlib.suppress(ProcessLookupError, FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False
