"""``demohlm benchmark dataset``."""

import json
from dataclasses import dataclass

from gym_demohlm.errors import DatasetError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm benchmark dataset``.

    Attributes:
        rounds: Turns of 8 episodes each, by LeRobot's writer and by ours.
        run_episodes: Episodes of the long run; 0 leaves it out.
    """

    rounds: int = 4
    run_episodes: int = 5000


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON.

    Raises:
        DatasetError: A count that makes no sense, or a difference to LeRobot's files.
    """
    from datasets import disable_progress_bars

    from lerobot_demohlm.benchmarks.dataset import measure_memory, measure_speed

    if options.rounds < 1 or options.run_episodes < 0:
        raise DatasetError(
            f"rounds={options.rounds}, run_episodes={options.run_episodes}", "1 and 0 or more", "correct them"
        )
    disable_progress_bars()  # LeRobot's image step would draw one an episode
    memory = measure_memory(options.run_episodes) if options.run_episodes else {}
    print(json.dumps(measure_speed(options.rounds) | memory))
