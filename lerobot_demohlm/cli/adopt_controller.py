"""``demohlm adopt-controller``."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lerobot_demohlm.cli.parsing import default


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm adopt-controller``.

    Attributes:
        weights: File of the new controller, as `demohlm train-controller` exports it.
        work: Directory of what is found; the same command goes on from there.
        num_robots: Robots of the benchmark.
        seconds: Length of their episodes [s].
        num_attempts: Attempts generated in each task.
        num_workers: Processes, and threads of the benchmark.
        seed: Of commands, pushes and starts.
        only_check: Make all checks and change nothing.
        docs: Folder whose figures and tables are made again with the new controller.
    """

    weights: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="WEIGHTS")]
    work: Path = Path("runs/adoption")
    num_robots: int = 624
    seconds: float = 20.0
    num_attempts: int = 100
    num_workers: int = 2
    seed: int = 7000
    only_check: bool = False
    docs: Annotated[Path | None, default("none")] = None


def run(options: Options) -> int:
    """Check and adopt; exit code 1 where the controller falls short. The last line on stdout is a JSON object."""
    from lerobot_demohlm.adoption.adopt import NotAdoptedError, check, switch
    from lerobot_demohlm.adoption.steps import Request
    from lerobot_demohlm.checks import portability

    request = Request(
        weights=options.weights,
        work=options.work,
        num_robots=options.num_robots,
        seconds=options.seconds,
        num_attempts=options.num_attempts,
        num_workers=options.num_workers,
        seed=options.seed,
    )
    try:
        found = check(request, lambda name: print(name, flush=True))
    except NotAdoptedError as error:
        print(error)
        print(json.dumps({"adopted": False, "reason": error.got}))
        return 1
    name = None if options.only_check else switch(request)
    if name is not None:
        for call in _after(portability.PACKAGED, options.docs):
            subprocess.run([sys.executable, "-m", "lerobot_demohlm.cli", *call], check=True)
    print(json.dumps({"adopted": name is not None, "controller": name, "checks": len(found)}))
    return 0


def _after(digests: Path, docs: Path | None) -> list[list[str]]:
    """Return the calls that make again what depends on the default controller."""
    calls = [["doctor", "--tasks", "--write", str(digests)]]
    if docs is not None:
        calls += [
            ["benchmark", "controller", "figures", "--root", str(docs)],
            ["results", "--output", str(docs / "results.md"), "--readme", str(docs.parent / "README.md")],
        ]
    return calls
