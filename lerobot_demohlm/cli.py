"""``demohlm VERB ...`` -> the function of the module that owns the verb.

A verb's module has ``add_arguments(parser)`` and ``main(arguments)``; it is imported when its verb is asked for and not
before, so that ``demohlm --help`` answers at once. What a user has done wrong is one line on stderr and exit code 2.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from gym_demohlm.errors import DemoHLMError

INTERRUPTED = 130  # exit code of a process that was stopped from the keyboard
# Modules that come with an extra of the distribution.
_EXTRAS = {"rsl_rl": "wbc", "matplotlib": "wbc", "av": "wbc", "ray": "ray"}


@dataclass(frozen=True, kw_only=True)
class Verb:
    """One thing that ``demohlm`` can do.

    Attributes:
        name: One word, or two where a verb has several objects.
        module: Where it is done.
        help: What it does, in a line.
        example: A call that works as it stands.
    """

    name: str
    module: str
    help: str
    example: str


VERBS = (
    Verb(
        name="quickstart",
        module="lerobot_demohlm.quickstart",
        help="generate a small dataset, train a policy on it, score it, and write a report, in ten minutes",
        example="demohlm quickstart",
    ),
    Verb(
        name="record",
        module="lerobot_demohlm.teleop.record",
        help="record a demonstration with the task's scripted operator",
        example="demohlm record --task LiftBox --root demonstrations/lift_box",
    ),
    Verb(
        name="replay",
        module="lerobot_demohlm.replay",
        help="replay a demonstration and compare it with its recording, bit for bit",
        example="demohlm replay --task LiftBox",
    ),
    Verb(
        name="segment",
        module="lerobot_demohlm.segmentation",
        help="show where a demonstration is cut, and at which contacts",
        example="demohlm segment --task LiftBox",
    ),
    Verb(
        name="generate",
        module="lerobot_demohlm.generation.runner",
        help="turn one demonstration into a LeRobot dataset of many episodes",
        example="demohlm generate --task LiftBox --region R3 --num-episodes 100 --num-workers 2 --root data/lift_box",
    ),
    Verb(
        name="push",
        module="lerobot_demohlm.push",
        help="upload a dataset to the Hugging Face hub",
        example="demohlm push --root data/lift_box --repo-id USER/lift_box",
    ),
    Verb(
        name="train",
        module="lerobot_demohlm.training",
        help="train the chunked MLP on a dataset, with LeRobot's training and the data held in memory",
        example="demohlm train --root data/lift_box --output outputs/lift_box",
    ),
    Verb(
        name="evaluate",
        module="lerobot_demohlm.evaluation",
        help="roll a policy out from seeded starts and write one JSON line an episode",
        example="demohlm evaluate --policy outputs/lift_box/pretrained_model --task LiftBox --region R2",
    ),
    Verb(
        name="report",
        module="lerobot_demohlm.report",
        help="write one HTML page about a dataset and the rollouts of a policy",
        example="demohlm report --root data/lift_box --evaluation results.jsonl --output report.html",
    ),
    Verb(
        name="gallery",
        module="lerobot_demohlm.gallery",
        help="draw an episode of each task as film strips and videos from two cameras, on one HTML page",
        example="demohlm gallery --root outputs/gallery",
    ),
    Verb(
        name="results",
        module="lerobot_demohlm.results",
        help="turn the measured results of this repository into the tables of its README",
        example="demohlm results --readme README.md",
    ),
    Verb(
        name="lint-task",
        module="lerobot_demohlm.lint",
        help="check what a task calls success and failure, what it lets a policy see, and its physics",
        example="demohlm lint-task LiftBox",
    ),
    Verb(
        name="benchmark controller",
        module="gym_demohlm.wbc.benchmark",
        help="measure how well the whole-body controller follows its commands",
        example="demohlm benchmark controller",
    ),
    Verb(
        name="benchmark reach",
        module="gym_demohlm.wbc.reach",
        help="measure how near the palms come to targets, and draw where they can",
        example="demohlm benchmark reach --output docs/reach.png",
    ),
    Verb(
        name="train-controller",
        module="gym_demohlm.wbc.train",
        help="train the whole-body controller by reinforcement learning",
        example="demohlm train-controller --hours 2",
    ),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program's name; those of the process by default.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _run(arguments)
    except DemoHLMError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: list[str]) -> int:
    for verb in VERBS:
        words = verb.name.split()
        if arguments[: len(words)] == words:
            return _carry_out(verb, arguments[len(words) :])
    _overview().parse_args(arguments)  # prints help, or says which verbs there are
    return 2


def _carry_out(verb: Verb, arguments: list[str]) -> int:
    try:
        module = importlib.import_module(verb.module)
        parser = argparse.ArgumentParser(
            prog=f"demohlm {verb.name}", description=_sentence(verb.help), epilog=f"example: {verb.example}"
        )
        module.add_arguments(parser)
        return module.main(parser.parse_args(arguments)) or 0
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        raise DemoHLMError(
            f"an installation without {error.name}", f"the extra [{extra}]", f"uv sync --extra {extra}"
        ) from error


def _overview() -> argparse.ArgumentParser:
    width = max(len(verb.name) for verb in VERBS)
    lines = [f"  {verb.name:<{width}}  {verb.help}" for verb in VERBS]
    parser = argparse.ArgumentParser(
        prog="demohlm",
        description="One demonstration of a humanoid at work in, checked LeRobot datasets and scored policies out.",
        epilog="verbs:\n" + "\n".join(lines) + "\n\n`demohlm VERB --help` tells more of each.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    words = sorted({verb.name.split()[0] for verb in VERBS})
    parser.add_argument("verb", metavar="VERB", choices=words, help="what to do: see below")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="of the verb")
    return parser


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."


if __name__ == "__main__":
    sys.exit(main())
