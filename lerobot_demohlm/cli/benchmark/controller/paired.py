"""``demohlm benchmark controller paired``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from lerobot_demohlm.cli.benchmark.controller import Size
from lerobot_demohlm.cli.choices import Protocol
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_comparisons


@dataclass(frozen=True, kw_only=True)
class Paired(Size):
    """How many robots a paired comparison has, and where its lines go.

    Attributes:
        num_seeds: Seeds that share the robots.
        append: File that a line of results for each comparison is added to.
    """

    num_seeds: int = 3
    append: Annotated[Path | None, default("none")] = None

    @property
    def call(self) -> str:
        """Return the words that ask for this size."""
        return (
            f"--num-worlds {self.num_worlds} --seconds {self.seconds:g} --seed {self.seed} --num-seeds {self.num_seeds}"
        )


@dataclass(frozen=True, kw_only=True)
class Options(Paired):
    """Options of ``demohlm benchmark controller paired``.

    Attributes:
        controllers: Two or more names, paths of weights, or first digits of hashes; "holosoma" and "holosoma-ppo" are
            public controllers. The first is the one that the others are compared with.
        protocol: "whole" asks for the whole command range, with loads. "arms" asks for velocities and moving arms of an
            upright robot, with loads. "velocity" asks for velocities alone. Public controllers take the last two.
        physics: Of the robots: the first version, or the second with self-collision, dry friction and peak torques.
    """

    controllers: tuple[str, ...]
    protocol: Protocol = "whole"
    physics: Annotated[Literal["first", "second"] | None, default("the first controller's")] = None


def run(options: Options) -> None:
    """Measure and print a table for each controller; the last line on stdout is the results as JSON."""
    from gym_demohlm.wbc.evaluation.contest import contest

    call = f"paired --controllers {' '.join(options.controllers)} --protocol {options.protocol} {options.call}"
    call += f" --physics {options.physics}" if options.physics else ""
    found = contest(
        options.controllers,
        options.protocol,
        *options.numbers,
        num_seeds=options.num_seeds,
        physics=options.physics,
    )
    print_comparisons(found, f"demohlm benchmark controller {call}", options.append)
