"""``demohlm benchmark controller ablation``."""

from dataclasses import dataclass
from typing import Annotated

from lerobot_demohlm.cli.benchmark.controller.paired import Paired
from lerobot_demohlm.cli.parsing import default
from lerobot_demohlm.cli.printing import print_comparisons


@dataclass(frozen=True, kw_only=True)
class Options(Paired):
    """Options of ``demohlm benchmark controller ablation``.

    Attributes:
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        parts: What is left out, such as "velocity-map", one at a time.
    """

    controller: str = "default"
    parts: Annotated[tuple[str, ...], default("each that the controller has")] = ()


def run(options: Options) -> None:
    """Measure and print a table for each part; the last line on stdout is the results as JSON."""
    from gym_demohlm.wbc.evaluation.contest import ABLATIONS, ablate

    call = f"ablation --controller {options.controller} {options.call}"
    call += f" --parts {' '.join(options.parts)}" if options.parts else ""
    found = ablate(options.controller, options.parts or tuple(ABLATIONS), *options.numbers, num_seeds=options.num_seeds)
    print_comparisons(found, f"demohlm benchmark controller {call}", options.append)
