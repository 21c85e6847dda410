"""The same run by 1, 2 and 5 workers, in processes and on Ray -> attempts an hour, and whether the data is the same.

Run ``uv run python -m lerobot_demohlm.benchmarks.workers``; every file of every dataset is compared, byte for byte,
with that of one worker. The last line on stdout is one JSON object.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from lerobot_demohlm.benchmarks.faults import digest
from lerobot_demohlm.generation.request import Backend, GenerationRequest
from lerobot_demohlm.generation.runner import generate


def measure(task: str, region: str, num_attempts: int, settings: list[tuple[Backend, int]]) -> dict[str, Any]:
    """Generate once with each backend and number of workers.

    Args:
        task: Name of the task.
        region: Initial region.
        num_attempts: Of each run.
        settings: Backend and number of workers; all are compared with the first.
    """
    runs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        digests = []
        for index, (backend, workers) in enumerate(settings):
            root = Path(scratch) / str(index) / "data"
            request = GenerationRequest(
                task=task,
                region=region,
                seed=0,
                root=root,
                num_attempts=num_attempts,
                num_workers=workers,
                backend=backend,
                repo_id="local/compared",
                show_progress=False,
            )
            began = time.monotonic()
            generate(request)
            hours = (time.monotonic() - began) / 3600
            digests.append(digest(root))
            runs.append(
                {
                    "backend": backend,
                    "workers": workers,
                    "attempts_per_hour": round(num_attempts / hours),
                    "same": digests[-1] == digests[0],
                }
            )
        files = len(digests[0])
    return {"task": task, "region": region, "attempts": num_attempts, "files": files, "runs": runs}


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="LiftBox")
    parser.add_argument("--region", default="R3")
    parser.add_argument("--num-attempts", type=int, default=160)
    parser.add_argument("--without-ray", action="store_true")
    arguments = parser.parse_args()
    settings: list[tuple[Backend, int]] = [("processes", 1), ("processes", 2), ("processes", 5)]
    if not arguments.without_ray:
        settings.append(("ray", 2))
    print(json.dumps(measure(arguments.task, arguments.region, arguments.num_attempts, settings)))


if __name__ == "__main__":
    main()
