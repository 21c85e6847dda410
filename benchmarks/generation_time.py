"""Attempts on one core -> seconds an episode, and the share of them inside MuJoCo's step.

``uv run python benchmarks/generation_time.py --region R2``; set OMP_NUM_THREADS=1. The last line on stdout is
one JSON object. The share counts ``mujoco.rollout``, which is ``mj_step`` in a loop in C.
"""

import argparse
import json
import time
from typing import Any

from mujoco import rollout

from gym_demohlm.task import get_task
from lerobot_demohlm import demonstration
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.runner import BLOCK_SIZE


class _Clock:
    """Adds up the time spent in a function."""

    def __init__(self, function: Any) -> None:  # noqa: ANN401
        self._function, self.seconds = function, 0.0

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:  # noqa: ANN401
        began = time.process_time()
        try:
            return self._function(*arguments, **keywords)
        finally:
            self.seconds += time.process_time() - began


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="LiftBox")
    parser.add_argument("--region", default="R2")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--num-attempts", type=int, default=16)
    arguments = parser.parse_args()
    task = get_task(arguments.task)
    attempts = Attempts(task, demonstration.load(None, task), arguments.region, arguments.seed, BLOCK_SIZE)
    clock = _Clock(rollout.Rollout.rollout)
    rollout.Rollout.rollout = lambda self, *a, **k: clock(self, *a, **k)  # type: ignore[method-assign]
    began = time.process_time()
    episodes = attempts.run(range(arguments.num_attempts))
    seconds = time.process_time() - began
    successes = [episode for episode in episodes if episode.outcome == "success"]
    found = {
        "task": task.name,
        "region": arguments.region,
        "seed": arguments.seed,
        "attempts": len(episodes),
        "seconds_per_episode": round(seconds / max(len(successes), 1), 3),
        "mj_step_share": round(clock.seconds / seconds, 3),
        "simulated_s_per_episode": round(sum(episode.length_s for episode in successes) / max(len(successes), 1), 2),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
