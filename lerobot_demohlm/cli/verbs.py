"""The verbs of ``demohlm``, by group, and the overview that ``demohlm --help`` prints."""

from collections.abc import Mapping
from dataclasses import dataclass, field

GROUPS = ("begin here", "demonstrations", "data", "policies", "robot", "checks", "reports", "benchmarks", "training")


@dataclass(frozen=True, kw_only=True)
class Verb:
    """One thing that ``demohlm`` can do.

    Attributes:
        name: Its words.
        group: One of ``GROUPS``.
        help: What it does, in a line.
        example: A call that works as it stands.
        moved: Former flags, and the verb that each has become.
    """

    name: str
    group: str
    help: str
    example: str
    moved: Mapping[str, str] = field(default_factory=dict)

    @property
    def words(self) -> tuple[str, ...]:
        """Return the words of its name."""
        return tuple(self.name.split())

    @property
    def module(self) -> str:
        """Return the file that owns it: ``benchmark trade-off`` is ``cli/benchmark/trade_off.py``."""
        return ".".join(("lerobot_demohlm.cli", *(word.replace("-", "_") for word in self.words)))

    @property
    def sentence(self) -> str:
        """Return what it does as a sentence."""
        return self.help[0].upper() + self.help[1:] + "."


VERBS = (
    Verb(
        name="quickstart",
        group="begin here",
        help="generate a small dataset, train a policy on it, score it, and write a report, in some minutes",
        example="demohlm quickstart",
    ),
    Verb(
        name="doctor",
        group="begin here",
        help="look at this machine: versions, graphics, room, and whether it computes the packaged bits",
        example="demohlm doctor",
    ),
    Verb(
        name="record",
        group="demonstrations",
        help="record a demonstration with the task's scripted operator, or by a person at a web page",
        example="demohlm record --task LiftBox --root demonstrations/lift_box",
    ),
    Verb(
        name="replay",
        group="demonstrations",
        help="replay a demonstration and compare it with its recording, bit for bit",
        example="demohlm replay --task LiftBox",
    ),
    Verb(
        name="segment",
        group="demonstrations",
        help="show where a demonstration is cut, and at which contacts",
        example="demohlm segment --task LiftBox",
    ),
    Verb(
        name="generate",
        group="data",
        help="turn one demonstration into a LeRobot dataset of many episodes",
        example="demohlm generate --task LiftBox --region R3 --num-episodes 100 --num-workers 2 --root data/lift_box",
    ),
    Verb(
        name="card",
        group="data",
        help="write a dataset's card into the folder of ready cards, or render all of them again",
        example="demohlm card --root data/lift_box --repo-id USER/lift_box",
    ),
    Verb(
        name="push",
        group="data",
        help="upload a dataset to the Hugging Face hub",
        example="demohlm push --root data/lift_box --repo-id USER/lift_box",
    ),
    Verb(
        name="train",
        group="policies",
        help="train a policy on a dataset by a preset, with LeRobot's training and the data held in memory",
        example="demohlm train --root data/lift_box --policy act --preset cpu --output outputs/lift_box",
    ),
    Verb(
        name="evaluate",
        group="policies",
        help="roll a policy out from seeded starts and write one JSON line an episode",
        example="demohlm evaluate --policy outputs/mlp/checkpoints/last/pretrained_model --task LiftBox --region R2",
    ),
    Verb(
        name="leaderboard",
        group="policies",
        help="score a policy under the fixed protocol of docs/benchmark.md, or check a result file",
        example="demohlm leaderboard --policy outputs/act/checkpoints/last/pretrained_model --task LiftBox",
    ),
    Verb(
        name="reproduce",
        group="policies",
        help="run what is missing of one of the paper's tables: generate, train, roll out",
        example="demohlm reproduce --table main --budget-hours 3 --num-workers 2",
    ),
    Verb(
        name="deploy",
        group="robot",
        help="have a policy drive a G1, real or simulated, at the other end of a network",
        example="demohlm deploy --policy outputs/mlp/checkpoints/last/pretrained_model --task LiftBox --interface lo",
    ),
    Verb(
        name="simulate-robot",
        group="robot",
        help="be a G1 in MuJoCo that speaks the robot's own protocol, with faults on request",
        example="demohlm simulate-robot --task LiftBox --interface lo",
    ),
    Verb(
        name="robot-check",
        group="robot",
        help="listen to a robot and say what a deployment would refuse; nothing is sent to its motors",
        example="demohlm robot-check --interface enp2s0",
    ),
    Verb(
        name="verify",
        group="checks",
        help="simulate episodes of a dataset again and compare them with it, bit for bit",
        example="demohlm verify --root data/lift_box --sample 20",
    ),
    Verb(
        name="lint-task",
        group="checks",
        help="check what a task calls success and failure, what it lets a policy see, and its physics",
        example="demohlm lint-task LiftBox",
    ),
    Verb(
        name="report",
        group="reports",
        help="write one HTML page about a dataset and the rollouts of a policy, or about the experiments",
        example="demohlm report --root data/lift_box --evaluation results.jsonl --output report.html",
    ),
    Verb(
        name="explain",
        group="reports",
        help="write an HTML page that explains a generation run, or one of its attempts",
        example="demohlm explain --root data/lift_box --attempt 3 --output attempt_3.html",
    ),
    Verb(
        name="gallery",
        group="reports",
        help="draw an episode of each task as film strips and videos from two cameras, on one HTML page",
        example="demohlm gallery --root outputs/gallery",
    ),
    Verb(
        name="results",
        group="reports",
        help="turn the measured results of this repository into docs/results.md and the README's table",
        example="demohlm results --output docs/results.md "
        "--readme README.md --pages docs/perception.md docs/policies.md docs/variation.md",
    ),
    Verb(
        name="benchmark",
        group="benchmarks",
        help="run the benchmarks of simulation, generation and dataset and sum them up",
        example="demohlm benchmark --task LiftBox",
    ),
    Verb(
        name="benchmark simulation",
        group="benchmarks",
        help="measure how many physics steps a second the simulation makes, and MuJoCo's step alone",
        example="demohlm benchmark simulation --task LiftBox",
    ),
    Verb(
        name="benchmark generation",
        group="benchmarks",
        help="measure the CPU time of attempts and where it goes, or their speed in worlds that vary and in plain ones",
        example="demohlm benchmark generation --task LiftBox --region R2 --num-attempts 16",
    ),
    Verb(
        name="benchmark pictures",
        group="benchmarks",
        help="measure what pictures add to the CPU time of attempts",
        example="demohlm benchmark pictures --task GraspCube",
    ),
    Verb(
        name="benchmark dataset",
        group="benchmarks",
        help="measure how many episodes a second are written, by LeRobot's writer too, and the memory of a long run",
        example="demohlm benchmark dataset",
    ),
    Verb(
        name="benchmark loading",
        group="benchmarks",
        help="measure how many samples a second LeRobot's loader gives, and ours from memory",
        example="demohlm benchmark loading --chunk 20 --batch-size 512",
    ),
    Verb(
        name="benchmark training",
        group="benchmarks",
        help="measure how many samples a second lerobot-train takes with data in memory, and as LeRobot reads them",
        example="demohlm benchmark training --policies mlp",
    ),
    Verb(
        name="benchmark evaluation",
        group="benchmarks",
        help="measure how many rollouts an hour lerobot-eval makes, and demohlm evaluate",
        example="demohlm benchmark evaluation --task LiftBox",
    ),
    Verb(
        name="benchmark controller",
        group="benchmarks",
        help="measure how well the whole-body controller follows its commands",
        example="demohlm benchmark controller",
        moved={
            "--robustness": "benchmark controller robustness",
            "--trade-off": "benchmark controller trade-off",
            "--peer": "benchmark controller peer",
            "--peer-range": "benchmark controller peer --own-range",
            "--figures": "benchmark controller figures",
            "--run": "benchmark controller figures",
            "--compare": "benchmark controller compare",
        },
    ),
    Verb(
        name="benchmark controller robustness",
        group="benchmarks",
        help="measure how often the robot stays up under disturbances that training did not aim at",
        example="demohlm benchmark controller robustness --num-worlds 64",
    ),
    Verb(
        name="benchmark controller trade-off",
        group="benchmarks",
        help="measure and draw the controller's errors over shares of its command range and over hand loads",
        example="demohlm benchmark controller trade-off --root docs --num-worlds 48",
    ),
    Verb(
        name="benchmark controller peer",
        group="benchmarks",
        help="measure a public controller as ours is measured",
        example="demohlm benchmark controller peer --name holosoma --hand-load 0",
    ),
    Verb(
        name="benchmark controller paired",
        group="benchmarks",
        help="compare controllers, public ones too, under the same commands, loads and pushes",
        example="demohlm benchmark controller paired --controllers default 8ac4c8cd0008 --num-worlds 192",
    ),
    Verb(
        name="benchmark controller ablation",
        group="benchmarks",
        help="compare a controller with itself without parts of its settings, not trained again",
        example="demohlm benchmark controller ablation --num-worlds 96 --num-seeds 2",
    ),
    Verb(
        name="benchmark controller figures",
        group="benchmarks",
        help="draw figures of the controller and a video of it",
        example="demohlm benchmark controller figures --root docs --run runs/controller",
    ),
    Verb(
        name="benchmark controller compare",
        group="benchmarks",
        help="draw the learning curves of several training runs of the controller",
        example="demohlm benchmark controller compare --root docs --runs runs/full runs/no_symmetry",
    ),
    Verb(
        name="benchmark reach",
        group="benchmarks",
        help="measure how near the palms come to targets, and draw where they can",
        example="demohlm benchmark reach --output docs/reach.png",
    ),
    Verb(
        name="benchmark teleoperation",
        group="benchmarks",
        help="measure the latency and pace of the page's server with a headset and a spectator",
        example="demohlm benchmark teleoperation --seconds 60",
    ),
    Verb(
        name="benchmark deployment",
        group="benchmarks",
        help="measure the way to a simulated robot: rates, ages, answers to kills and faults, success",
        example="demohlm benchmark deployment --part link --seconds 60",
    ),
    Verb(
        name="benchmark perception",
        group="benchmarks",
        help="measure a policy's success against bias, latency and loss of its poses, camera errors and mesh scale",
        example="demohlm benchmark perception --figure curves.png",
    ),
    Verb(
        name="benchmark perturbed",
        group="benchmarks",
        help="measure generation from demonstrations of operators who are late, tremble, pause and lose tracking",
        example="demohlm benchmark perturbed --tasks LiftBox --num-operators 2",
    ),
    Verb(
        name="benchmark feedback",
        group="benchmarks",
        help="measure what generation loses without its feedback, as the paper replays, and without symmetry",
        example="demohlm benchmark feedback --tasks LiftBox --variations none",
    ),
    Verb(
        name="benchmark robustness",
        group="benchmarks",
        help="measure a policy's success in worlds that vary, one group of factors at a time, at three strengths",
        example="demohlm benchmark robustness --policy outputs/act/checkpoints/last/pretrained_model --task LiftBox",
    ),
    Verb(
        name="benchmark tracking",
        group="benchmarks",
        help="measure how near object poses from drawn pictures come to the truth, and what a frame costs",
        example="demohlm benchmark tracking --tasks LiftBox",
    ),
    Verb(
        name="benchmark variation",
        group="benchmarks",
        help="probe what generation makes of worlds that vary, one group of factors at a time",
        example="demohlm benchmark variation --tasks LiftBox --variations real:objects real:pushes",
    ),
    Verb(
        name="pose-server",
        group="policies",
        help="serve object poses to environments with perception=remote, from the pictures that they send",
        example="demohlm pose-server --backend tracker",
    ),
    Verb(
        name="fit-perception",
        group="training",
        help="fit the error model of perception=model to what the tracker makes of drawn pictures",
        example="demohlm fit-perception --task LiftBox --num-episodes 2 --num-checks 1 --output lift_box.json",
    ),
    Verb(
        name="train-controller",
        group="training",
        help="train the whole-body controller by reinforcement learning",
        example="demohlm train-controller --hours 2",
    ),
    Verb(
        name="tune-controller",
        group="training",
        help="write a controller that walks with other settings of its gait, not trained again",
        example="demohlm tune-controller --gait recovery_s=4 --output runs/tuned.npz",
    ),
    Verb(
        name="controllers",
        group="training",
        help="list the installed whole-body controllers with their physics and measured numbers",
        example="demohlm controllers",
    ),
    Verb(
        name="adopt-controller",
        group="training",
        help="check a trained controller in every way, and make it the default one if it is worse in nothing",
        example="demohlm adopt-controller runs/controller/calibrated.npz",
    ),
)


def overview() -> str:
    """Return what ``demohlm --help`` prints: every verb with what it does, by group."""
    width = max(len(verb.name) for verb in VERBS)
    lines = [
        "usage: demohlm VERB [OPTIONS]",
        "",
        "One demonstration of a humanoid at work in, checked LeRobot datasets and scored policies out.",
    ]
    for group in GROUPS:
        lines += ["", f"{group}:"]
        lines += [f"  {verb.name:<{width}}  {verb.help}" for verb in VERBS if verb.group == group]
    lines += [
        "",
        "`demohlm VERB --help` says more about each. `demohlm --print-completion bash` (or zsh) prints a script that",
        "completes verbs and options in the shell.",
    ]
    return "\n".join(lines)
