"""A small generation run and what can go wrong around it -> a table: tried, survived, lost.

Run ``uv run python -m lerobot_demohlm.benchmarks.faults --kills 50``, and change no code meanwhile: its hash is part of
a dataset. A fault is survived where the run goes on, or ends with one clear message and goes on when it is asked for
again, and in the end has made, byte for byte, the dataset of a run that nothing happened to. Lost is what was on disk
before the fault and is not after it, beside blocks that were damaged on purpose. The last line on stdout is one JSON
object.
"""

import argparse
import contextlib
import hashlib
import json
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.benchmarks import brief_task
from lerobot_demohlm.datasets.facts import GenerationFacts
from lerobot_demohlm.demonstrations import demonstration
from lerobot_demohlm.generation.request import BLOCK_SIZE
from lerobot_demohlm.generation.run import GenerationRun, partial_directory

CLOCK = """
import random, time
_time, _random = time.time, random.Random(0)
time.time = lambda: _time() + _random.uniform(-1e5, 1e5)
time.time_ns = lambda: int(time.time() * 1e9)
"""


@dataclass(frozen=True, kw_only=True)
class Tally:
    """What became of one kind of fault.

    Attributes:
        fault: Which.
        tried: How often.
        survived: How often it was survived.
        lost: Finished blocks, datasets or demonstrations that it took.
        note: Why it was not tried.
    """

    fault: str
    tried: int
    survived: int
    lost: int = 0
    note: str = ""


def digest(root: Path) -> dict[str, str]:
    """Return a hash of every file under a directory by its path; nothing where there is no directory."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


class Bench:
    """Runs ``demohlm generate`` on a task with brief attempts, again and again.

    Args:
        scratch: An empty directory.
        num_attempts: Of each run; four blocks or more, as some faults come once there are three.
        num_workers: Of each run, but for the reference, which has one.
    """

    def __init__(self, scratch: Path, num_attempts: int = 6 * BLOCK_SIZE, num_workers: int = 2) -> None:
        self.scratch, self.num_attempts, self.num_workers = scratch, num_attempts, num_workers
        self.demonstration = scratch / "demonstration"
        brief_task.save_demonstration(self.demonstration)
        self._roots = 0
        began = time.monotonic()
        reference = self.root()
        code, messages = self.finish(self.start(reference, num_workers=1))
        assert code == 0, messages
        self.whole_s = time.monotonic() - began
        self.reference = digest(reference)

    def root(self) -> Path:
        """Return a root that was not used before."""
        self._roots += 1
        return self.scratch / f"data{self._roots}"

    def start(self, root: Path, num_workers: int | None = None, path: tuple[Path, ...] = ()) -> subprocess.Popen[str]:
        """Start a run, or go on with it, as a command in a process group of its own."""
        options = {
            "--task": "lerobot_demohlm.benchmarks.brief_task:LiftBoxBriefly",
            "--region": "R1",
            "--num-attempts": self.num_attempts,
            "--num-workers": num_workers or self.num_workers,
            "--demonstration": self.demonstration,
            "--root": root,
        }
        words = [str(word) for option in options.items() for word in option]
        places = [str(place) for place in path]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([*places, os.environ.get("PYTHONPATH", "")])}
        return subprocess.Popen(
            [sys.executable, "-m", "lerobot_demohlm.cli", "generate", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )

    def finish(self, process: subprocess.Popen[str]) -> tuple[int, list[str]]:
        """Wait for a run and its workers; return its exit code and its messages, all that is no progress bar."""
        _, text = process.communicate()
        lines = [line.strip() for line in text.replace("\r", "\n").split("\n")]
        return process.returncode, [line for line in lines if line and not line.startswith(brief_task.TASK.name)]

    def run(self, root: Path) -> tuple[int, list[str]]:
        """Start a run, or go on with it, and wait for it."""
        return self.finish(self.start(root))

    def ends_well(self, root: Path) -> bool:
        """Go on with a run, unless it is over, and tell whether it made what it should."""
        code = 0 if root.exists() else self.run(root)[0]
        return code == 0 and digest(root) == self.reference and not partial_directory(root).exists()

    def begun(self, root: Path, num_blocks: int = 3) -> subprocess.Popen[str]:
        """Start a run and return it once it has some blocks."""
        process = self.start(root)
        while len(blocks(root)) < num_blocks and process.poll() is None:
            time.sleep(0.02)
        return process


def blocks(root: Path) -> dict[str, dict[str, str]]:
    """Return the hashes of the finished blocks of a run by their names."""
    found = (partial_directory(root) / "blocks").glob("[0-9]*")
    return {path.name: digest(path) for path in found}


def missing(before: dict[str, dict[str, str]], root: Path) -> int:
    """Count the blocks that were there before and are not as they were; once merged they need not be."""
    now = blocks(root)
    return 0 if root.exists() else sum(now.get(name) != files for name, files in before.items())


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Return the process ids of a run's workers."""
    found = []
    with contextlib.suppress(OSError):
        for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(int(pid))
    return found


def is_clear(code: int, messages: list[str], expected_code: int, words: str) -> bool:
    """Tell whether a run ended as it should, with one message that says why; says what it got where not."""
    clear = code == expected_code and len(messages) == 1 and words in messages[0]
    if not clear:
        print(f"exit code {code}, expected {expected_code}; {messages}, expected {words!r}", file=sys.stderr)
    return clear


def kill(bench: Bench, times: int) -> Tally:
    """Kill the run or one of its workers at random moments."""
    rng = random.Random(0)
    tried = survived = lost = 0
    while tried < times:
        root, hits = bench.root(), 0
        before: dict[str, dict[str, str]] = {}
        while not root.exists():
            process = bench.start(root)
            while tried + hits < times:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=rng.uniform(0.0, bench.whole_s / 2))
                if process.poll() is not None:
                    break
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice([process.pid, *workers_of(process)]), signal.SIGKILL)
                    hits += 1
            bench.finish(process)
            lost += missing(before, root)
            before = blocks(root)
        tried, survived = tried + hits, survived + hits * bench.ends_well(root)
        lost += digest(root) != bench.reference
    return Tally(fault="kill -9 of the run or a worker", tried=tried, survived=survived, lost=lost)


def keep_killing_workers(bench: Bench, times: int) -> Tally:
    """Kill every worker as it appears: the run gives up and says why."""
    survived = lost = 0
    for _ in range(times):
        root = bench.root()
        process = bench.start(root)
        while process.poll() is None:
            for pid in workers_of(process):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.02)
        survived += is_clear(*bench.finish(process), 2, "killed by SIGKILL") and bench.ends_well(root)
    return Tally(fault="workers that keep dying", tried=times, survived=survived, lost=lost)


def interrupt(bench: Bench, times: int) -> Tally:
    """Press Ctrl-C, which all processes of a run receive."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what is in the background without it
    rng = random.Random(0)
    tried = survived = lost = 0
    while tried < times:
        root = bench.root()
        process = bench.begun(root, num_blocks=1)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=rng.uniform(0.0, bench.whole_s / 4))
        if process.poll() is not None:
            bench.finish(process)
            continue
        os.killpg(process.pid, signal.SIGINT)
        (code, messages), before = bench.finish(process), blocks(root)
        tried += 1
        code = 130 if code == -signal.SIGINT else code  # a shell cannot tell them apart
        survived += is_clear(code, messages, 130, "the same command goes on") and bench.ends_well(root)
        lost += missing(before, root)
    return Tally(fault="Ctrl-C", tried=tried, survived=survived, lost=lost)


@contextlib.contextmanager
def mounted(place: Path, size: int) -> Iterator[Callable[[str], None]]:
    """Mount an empty file system of some bytes and yield what mounts it anew with other options.

    Raises:
        PermissionError: It needs root.
    """
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    if subprocess.run(command, capture_output=True).returncode != 0:
        raise PermissionError("mounting needs root")
    try:
        yield lambda options: _run("mount", "-o", f"remount,{options}", place)
    finally:
        _run("umount", "-l", place)


def _run(*words: object) -> None:
    subprocess.run([str(word) for word in words], check=True)


def fill_the_disk(bench: Bench, times: int) -> Tally:
    """Run where there is room for a part of the blocks, or for all but not for the merged dataset as well."""
    fault = "disk full"
    size = sum(path.stat().st_size for path in (bench.scratch / "data1").rglob("*"))
    tried = survived = lost = 0
    try:
        for share in [0.05 + 1.6 * n / times for n in range(times)]:
            with mounted(bench.root(), 4096 * (1 + round(share * size / 4096))) as remount:
                root = bench.scratch / f"data{bench._roots}" / "data"
                ended, before = bench.run(root), blocks(root)
                remount("size=1g")
                tried += 1
                survived += is_clear(*ended, 2, "No space left on device") and bench.ends_well(root)
                lost += missing(before, root)
    except PermissionError as error:
        return Tally(fault=fault, tried=tried, survived=survived, lost=lost, note=str(error))
    return Tally(fault=fault, tried=tried, survived=survived, lost=lost)


def forbid_writing(bench: Bench, times: int) -> Tally:
    """Run where nothing may be written: from the beginning, or from the middle on."""
    fault, words = "read-only root", "Read-only file system"
    tried = survived = lost = 0
    try:
        for attempt in range(times):
            with mounted(bench.root(), 2**30) as remount:
                root = bench.scratch / f"data{bench._roots}" / "data"
                if attempt % 2:
                    process = bench.begun(root, num_blocks=1)
                    process.kill()
                    bench.finish(process)
                before = blocks(root)
                remount("ro")
                ended = bench.run(root)
                remount("rw")
                tried += 1
                lost += missing(before, root)
                survived += is_clear(*ended, 2, words) and bench.ends_well(root)
    except PermissionError as error:
        return Tally(fault=fault, tried=tried, survived=survived, lost=lost, note=str(error))
    return Tally(fault=fault, tried=tried, survived=survived, lost=lost)


def _flip(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path, random.Random], object]] = {
    "a bit flipped": _flip,
    "cut off": lambda path, rng: os.truncate(path, rng.randrange(path.stat().st_size)),
    "removed": lambda path, _: path.unlink(),
    "a file too many": lambda path, _: path.with_name("more").write_text("more"),
}


def damage_blocks(bench: Bench, times: int) -> Tally:
    """Damage a file of a block in every way, open the run, and go on with the last one."""
    rng = random.Random(0)
    begun = bench.root()
    process = bench.begun(begun)
    process.kill()
    bench.finish(process)
    facts = GenerationFacts.read(json.loads((partial_directory(begun) / "run.json").read_text()))
    tried = survived = lost = 0
    for _ in range(times):
        for damage in DAMAGES.values():
            root = bench.root()
            shutil.copytree(partial_directory(begun), partial_directory(root))
            before = blocks(root)
            name = rng.choice(sorted(before))
            del before[name]
            files = [p for p in sorted((partial_directory(root) / "blocks" / name).rglob("*")) if p.is_file()]
            damage(rng.choice(files), rng)
            GenerationRun.open(root, "user/name", facts).close()
            tried += 1
            lost += missing(before, root)
            survived += blocks(root) == before  # the damaged one is gone, to be made again
    survived -= not bench.ends_well(root)
    return Tally(fault="damaged block", tried=tried, survived=survived, lost=lost)


def damage_demonstration(bench: Bench, times: int) -> Tally:
    """Damage a file of the demonstration: it is refused, unless what was damaged is not used."""
    rng = random.Random(0)
    expected = demonstration.load(bench.demonstration).content_hash
    files = [name for name in digest(bench.demonstration) if name.endswith((".parquet", ".npz", "demonstration.json"))]
    tried = survived = 0
    for _ in range(times):
        for damage in DAMAGES.values():
            with tempfile.TemporaryDirectory(dir=bench.scratch) as scratch:
                copy = Path(shutil.copytree(bench.demonstration, Path(scratch) / "demonstration"))
                damage(copy / rng.choice(files), rng)
                tried += 1
                try:
                    survived += demonstration.load(copy).content_hash == expected
                except DemoHLMError:
                    survived += 1
    return Tally(fault="damaged demonstration", tried=tried, survived=survived)


def run_twice(bench: Bench, times: int) -> Tally:
    """Start three runs on one root at once: one makes the dataset, the others are refused."""
    survived = 0
    for _ in range(times):
        root = bench.root()
        ended = [bench.finish(process) for process in [bench.start(root) for _ in range(3)]]
        refused = [(code, messages) for code, messages in ended if code != 0]
        clear = all(is_clear(*end, 2, "--root") for end in refused)
        survived += len(refused) == 2 and clear and bench.ends_well(root)
    return Tally(fault="three runs on one root", tried=times, survived=survived)


def shake_the_clock(bench: Bench, times: int) -> Tally:
    """Run while the clock on the wall jumps by up to a day, back and forth, whenever it is read."""
    (bench.scratch / "clock").mkdir()
    (bench.scratch / "clock" / "sitecustomize.py").write_text(CLOCK)
    survived = 0
    for _ in range(times):
        root = bench.root()
        code, messages = bench.finish(bench.start(root, path=(bench.scratch / "clock",)))
        survived += code == 0 and not messages and bench.ends_well(root)
    return Tally(fault="clock jumps", tried=times, survived=survived)


def main() -> None:
    """Try every fault and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--times", type=int, default=4, help="tries of every other fault (default: %(default)s)")
    parser.add_argument("--num-attempts", type=int, default=6 * BLOCK_SIZE)
    parser.add_argument("--num-workers", type=int, default=2)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # blocks that are made again, in this process
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        bench = Bench(Path(scratch), arguments.num_attempts, arguments.num_workers)
        tallies = [kill(bench, arguments.kills)]
        others = (keep_killing_workers, interrupt, fill_the_disk, forbid_writing, damage_blocks)
        for fault in (*others, damage_demonstration, run_twice, shake_the_clock):
            tallies.append(fault(bench, arguments.times))
            print(tallies[-1], file=sys.stderr)
    print("| fault | tried | survived | lost |\n|---|---|---|---|")
    for tally in tallies:
        print(f"| {tally.fault} | {tally.tried or tally.note} | {tally.survived} | {tally.lost} |")
    sums = {key: sum(getattr(tally, key) for tally in tallies) for key in ("tried", "survived", "lost")}
    print(json.dumps(sums | {"seconds": round(time.monotonic() - began), "faults": [asdict(t) for t in tallies]}))


if __name__ == "__main__":
    main()
