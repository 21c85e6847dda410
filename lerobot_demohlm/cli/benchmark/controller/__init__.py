"""``demohlm benchmark controller``; the files beside this one own ``demohlm benchmark controller PART``."""

from dataclasses import dataclass

from gym_demohlm.wbc.evaluation.benchmark import LARGEST_HAND_LOAD
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange
from lerobot_demohlm.cli.printing import print_json


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much of the controller's benchmarks is run.

    Attributes:
        num_worlds: Robots, one episode each.
        seconds: Length of an episode [s].
        seed: Seed of commands, loads and pushes.
        num_threads: Threads of the physics.
    """

    num_worlds: int = 624
    seconds: float = 20.0
    seed: int = 0
    num_threads: int = 2

    @property
    def numbers(self) -> tuple[int, float, int, int]:
        """Return them in the order in which the benchmarks take them."""
        return self.num_worlds, self.seconds, self.seed, self.num_threads


@dataclass(frozen=True, kw_only=True)
class Commands(Size):
    """How much is run, and which commands are drawn.

    Attributes:
        roll: Largest torso roll of standing robots [rad].
        yaw: Largest torso yaw of standing robots [rad].
        hand_load: Largest mass in each hand [kg].
    """

    roll: float = 0.4
    yaw: float = 1.0
    hand_load: float = LARGEST_HAND_LOAD

    @property
    def ranges(self) -> CommandRange:
        """Return what commands are drawn from."""
        return CommandRange(roll=(-self.roll, self.roll), yaw=(-self.yaw, self.yaw))


@dataclass(frozen=True, kw_only=True)
class Options(Commands):
    """Options of ``demohlm benchmark controller``.

    Attributes:
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        num_seeds: Seeds that share the robots.
        velocity_only: Upright, arms still: what velocity policies are asked for.
    """

    controller: str = "default"
    num_seeds: int = 3
    velocity_only: bool = False


def run(options: Options) -> None:
    """Measure; the last line on stdout is the result as JSON."""
    from gym_demohlm.control import controllers
    from gym_demohlm.control.whole_body import Weights
    from gym_demohlm.wbc.evaluation.benchmark import benchmark, hand_error

    weights = controllers.find(options.controller)
    ranges = options.ranges.velocity_only() if options.velocity_only else options.ranges
    found = benchmark(
        *options.numbers, ranges, weights, num_seeds=options.num_seeds, largest_hand_load=options.hand_load
    )
    found |= {"velocity_only": options.velocity_only, "controller": Weights(weights).hash[: controllers.HASH_DIGITS]}
    if not options.velocity_only:
        found |= hand_error(options.num_worlds, options.seed, options.num_threads, weights)
    print_json(found)
