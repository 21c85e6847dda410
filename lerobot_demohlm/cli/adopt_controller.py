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
        docs: Folder of the documentation. Its figures and tables are drawn again for the new controller.
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
    from lerobot_demohlm.adoption.adopt import NotAdoptedError, check, is_default, switch
    from lerobot_demohlm.adoption.steps import Request

    request = Request(
        weights=options.weights,
        work=options.work,
        num_robots=options.num_robots,
        seconds=options.seconds,
        num_attempts=options.num_attempts,
        num_workers=options.num_workers,
        seed=options.seed,
    )
    if options.only_check or not is_default(request.weights):  # else a call before this one ended after the switch
        try:
            check(request, lambda name: print(name, flush=True))
        except NotAdoptedError as error:
            print(error)
            print(json.dumps({"adopted": False, "reason": error.got}))
            return 1
        if options.only_check:
            print(json.dumps({"adopted": False, "reason": "only checked; nothing fell short"}))
            return 0
        switch(request)
    for call in _after(options.docs):
        subprocess.run([sys.executable, *call], check=True)
    print(json.dumps({"adopted": True, "weights": str(request.weights)}))
    return 0


def _after(docs: Path | None) -> list[list[str]]:
    """Return the calls of Python that make again what depends on the default controller, which new processes have."""
    calls = [["-m", "lerobot_demohlm.adoption.digests"]]
    if docs is not None:
        demohlm = ["-m", "lerobot_demohlm.cli"]
        calls += [
            [*demohlm, "benchmark", "controller", "figures", "--root", str(docs)],
            [
                *demohlm,
                "results",
                "--output",
                str(docs / "results.md"),
                "--readme",
                str(docs.parent / "README.md"),
                "--pages",
                *(str(docs / f"{page}.md") for page in ("perception", "policies", "variation")),
            ],
        ]
    return calls
