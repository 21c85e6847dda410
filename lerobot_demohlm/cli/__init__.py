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
        module="lerobot_demohlm.demonstrations.replay",
        help="replay a demonstration and compare it with its recording, bit for bit",
        example="demohlm replay --task LiftBox",
    ),
    Verb(
        name="segment",
        module="lerobot_demohlm.demonstrations.segmentation",
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
        name="verify",
        module="lerobot_demohlm.checks.verify",
        help="simulate episodes of a dataset again and compare them with it, bit for bit",
        example="demohlm verify --root data/lift_box --sample 20",
    ),
    Verb(
        name="explain",
        module="lerobot_demohlm.reports.explain",
        help="write an HTML page that explains a generation run, or one of its attempts",
        example="demohlm explain --root data/lift_box --attempt 3 --output attempt_3.html",
    ),
    Verb(
        name="push",
        module="lerobot_demohlm.datasets.hub",
        help="upload a dataset to the Hugging Face hub",
        example="demohlm push --root data/lift_box --repo-id USER/lift_box",
    ),
    Verb(
        name="train",
        module="lerobot_demohlm.policies.training",
        help="train a policy on a dataset by a preset, with LeRobot's training and the data held in memory",
        example="demohlm train --root data/lift_box --policy act --preset cpu --output outputs/lift_box",
    ),
    Verb(
        name="evaluate",
        module="lerobot_demohlm.evaluation.evaluate",
        help="roll a policy out from seeded starts and write one JSON line an episode",
        example="demohlm evaluate --policy outputs/lift_box/pretrained_model --task LiftBox --region R2",
    ),
    Verb(
        name="reproduce",
        module="lerobot_demohlm.experiments.reproduce",
        help="run what is missing of one of the paper's tables: generate, train, roll out",
        example="demohlm reproduce --table main --budget-hours 3 --num-workers 2",
    ),
    Verb(
        name="report",
        module="lerobot_demohlm.reports.report",
        help="write one HTML page about a dataset and the rollouts of a policy, or about the experiments",
        example="demohlm report --root data/lift_box --evaluation results.jsonl --output report.html",
    ),
    Verb(
        name="gallery",
        module="lerobot_demohlm.reports.gallery",
        help="draw an episode of each task as film strips and videos from two cameras, on one HTML page",
        example="demohlm gallery --root outputs/gallery",
    ),
    Verb(
        name="results",
        module="lerobot_demohlm.experiments.readme_tables",
        help="turn the measured results of this repository into the tables of its README",
        example="demohlm results --readme README.md",
    ),
    Verb(
        name="lint-task",
        module="lerobot_demohlm.checks.lint",
        help="check what a task calls success and failure, what it lets a policy see, and its physics",
        example="demohlm lint-task LiftBox",
    ),
    Verb(
        name="benchmark controller",
        module="gym_demohlm.wbc.evaluation.benchmark",
        help="measure how well the whole-body controller follows its commands",
        example="demohlm benchmark controller",
    ),
    Verb(
        name="benchmark reach",
        module="gym_demohlm.wbc.evaluation.reach",
        help="measure how near the palms come to targets, and draw where they can",
        example="demohlm benchmark reach --output docs/reach.png",
    ),
    Verb(
        name="benchmark simulation",
        module="lerobot_demohlm.benchmarks.simulation",
        help="measure how many physics steps a second the simulation makes, and MuJoCo's step alone",
        example="demohlm benchmark simulation --task LiftBox",
    ),
    Verb(
        name="benchmark generation",
        module="lerobot_demohlm.benchmarks.generation",
        help="measure the CPU time of attempts, where it goes, and the episodes an hour and core",
        example="demohlm benchmark generation --task LiftBox --region R2 --num-attempts 16",
    ),
    Verb(
        name="benchmark dataset",
        module="lerobot_demohlm.benchmarks.dataset",
        help="measure how many episodes a second are written, by LeRobot's writer too, and the memory of a long run",
        example="demohlm benchmark dataset",
    ),
    Verb(
        name="benchmark loading",
        module="lerobot_demohlm.benchmarks.loading",
        help="measure how many samples a second LeRobot's loader gives, and ours from memory",
        example="demohlm benchmark loading --chunk 20 --batch-size 512",
    ),
    Verb(
        name="benchmark training",
        module="lerobot_demohlm.benchmarks.training",
        help="measure how many samples a second lerobot-train takes with data in memory, and as LeRobot reads them",
        example="demohlm benchmark training --policies mlp",
    ),
    Verb(
        name="benchmark evaluation",
        module="lerobot_demohlm.benchmarks.evaluation",
        help="measure how many rollouts an hour lerobot-eval makes, and demohlm evaluate",
        example="demohlm benchmark evaluation --task LiftBox",
    ),
    Verb(
        name="benchmark",
        module="lerobot_demohlm.benchmarks.suite",
        help="run the benchmarks of simulation, generation and dataset and sum them up",
        example="demohlm benchmark --task LiftBox",
    ),
    Verb(
        name="train-controller",
        module="gym_demohlm.wbc.training.train",
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
    except KeyboardInterrupt as stop:
        print(f"interrupted{f': {stop}' if str(stop) else ''}", file=sys.stderr)
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
