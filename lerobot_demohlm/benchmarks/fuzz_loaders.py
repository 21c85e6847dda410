"""Bytes that a fuzzer makes up -> every loader: each returns, or raises an error of this project, and none hangs.

Run ``uv run --with atheris python -m lerobot_demohlm.benchmarks.fuzz_loaders --seconds 3600``; the last line on stdout
is one JSON object.
The fuzzer starts from the files of LiftBox's demonstration and of a small run, and follows the branches of the loaders.
An input that breaks one is kept in the working directory as ``crash-*``, ``timeout-*`` or ``oom-*``.
"""

import argparse
import contextlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["lerobot_demohlm", "gym_demohlm.control.whole_body"]):
    from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, Weights
    from gym_demohlm.errors import DemoHLMError
    from gym_demohlm.registry import get_task
    from lerobot_demohlm.datasets import facts
    from lerobot_demohlm.datasets.episode import Episode
    from lerobot_demohlm.datasets.facts import GenerationFacts
    from lerobot_demohlm.datasets.variation import PLAIN
    from lerobot_demohlm.demonstrations import demonstration
    from lerobot_demohlm.demonstrations.segmentation import segment
    from lerobot_demohlm.generation.block import block_directory, read_block, write_block
    from lerobot_demohlm.generation.run import GenerationRun, partial_directory

TASK = get_task("LiftBox")
FACTS = GenerationFacts(
    task=TASK.name,
    task_text=TASK.description,
    region="R1",
    seed=0,
    demonstration_hash="",
    controller_hash="",
    model_hash="",
    num_episodes=None,
    num_attempts=1,
    block_size=8,
    keep_failures=False,
    variation=PLAIN,
)
LONGEST_S, MOST_MEMORY_MB = 20, 4096


def failure() -> Episode:
    """Return an attempt that failed before its first frame."""
    return Episode(
        task=TASK.name,
        task_text=TASK.description,
        index=0,
        seed=0,
        region="R1",
        outcome="off_course",
        stage="locomotion",
        state=np.zeros((0, 68), np.float32),
        environment_state=np.zeros((0, 9), np.float32),
        action=np.zeros((0, 23), np.float32),
        success=np.zeros(0, bool),
        initial_state=TASK.default_state(),
        length_s=0.0,
    )


def targets(scratch: Path) -> list[tuple[Path, Callable[[], object]]]:
    """Prepare a directory; return the files to be spoiled, each with who reads it."""
    recorded = Path(shutil.copytree(demonstration.default_root(TASK), scratch / "demonstration"))
    found = demonstration.load(recorded, TASK)
    sidecar = recorded / demonstration.CORRECTIONS_PATH
    sidecar.write_text(json.dumps({"segments": [vars(entry) for entry in segment(found, TASK)]}))
    run = GenerationRun.open(scratch / "data", "user/name", FACTS)
    write_block(run.directory, FACTS, range(1), [failure()])
    run.close()
    block = block_directory(run.directory, range(1))
    finished = scratch / "finished"
    (finished / "meta").mkdir(parents=True)
    facts.write_facts(finished, FACTS, [failure().record()])
    weights = Path(shutil.copy(DEFAULT_WEIGHTS, scratch / "weights.npz"))

    def read_demonstration() -> None:
        segment(demonstration.load(recorded), TASK)

    def read_run() -> None:
        GenerationRun.open(scratch / "data", "user/name", FACTS).close()

    return [
        (recorded / demonstration.META_PATH, read_demonstration),
        (recorded / demonstration.SNAPSHOTS_PATH, read_demonstration),
        (next((recorded / "data").rglob("*.parquet")), read_demonstration),
        (sidecar, read_demonstration),
        (partial_directory(scratch / "data") / "run.json", read_run),
        (block / "block.json", lambda: read_block(run.directory, FACTS, range(1))),
        (block / "attempts.jsonl", lambda: facts.read_records(block / "attempts.jsonl")),
        (finished / facts.FACTS_PATH, lambda: facts.read_facts(finished)),
        (weights, lambda: Weights(weights)),
    ]


def fuzz(options: list[str], corpus: Path) -> None:
    """Fuzz until the options of libFuzzer end it; the first byte of an input says whom it is for."""
    with tempfile.TemporaryDirectory() as scratch:
        found = targets(Path(scratch))
        whole = [path.read_bytes() for path, _ in found]
        for number, content in enumerate(whole):
            (corpus / str(number)).write_bytes(bytes([number]) + content)

        def once(content: bytes) -> None:
            number = content[0] % len(found) if content else 0
            path, read = found[number]
            path.write_bytes(content[1:])
            try:
                with contextlib.suppress(DemoHLMError):
                    read()
            finally:
                path.write_bytes(whole[number])

        atheris.Setup([sys.argv[0], *options, str(corpus)], once)
        atheris.Fuzz()


def main() -> None:
    """Run the fuzzer in a process of its own, which it ends in its own way, and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--corpus", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    limits = [f"-max_total_time={arguments.seconds}", f"-timeout={LONGEST_S}", f"-rss_limit_mb={MOST_MEMORY_MB}"]
    if arguments.corpus is not None:
        fuzz([*limits, "-max_len=400000", "-print_final_stats=1"], arguments.corpus)
        return
    with tempfile.TemporaryDirectory() as corpus:
        command = [sys.executable, __file__, "--seconds", str(arguments.seconds), "--corpus", corpus]
        ended = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    print(ended.stderr[-4000:], file=sys.stderr)
    executions = re.search(r"number_of_executed_units:\s*(\d+)", ended.stderr)
    found = {
        "seconds": arguments.seconds,
        "executions": int(executions.group(1)) if executions else 0,
        "broke": ended.returncode != 0,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
