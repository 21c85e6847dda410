"""Files of ``results/`` <-> typed results: the score of a policy, the success of generation, other measurements.

A line says what was measured, by which command, at which commit. Lines that an earlier version wrote stay readable: a
field that it did not know has a default here.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gym_demohlm import jsonl
from lerobot_demohlm.experiments.variants import sight, sight_stamp, stamp
from lerobot_demohlm.reproducibility.results import append_result


@dataclass(frozen=True, kw_only=True)
class Result:
    """What every line of results says.

    Attributes:
        command: What was run; empty before the result is written.
        commit: Commit at which it was run, with "+" for a changed working tree; empty before the result is written.
    """

    command: str = ""
    commit: str = ""


@dataclass(frozen=True, kw_only=True)
class PolicyResult(Result):
    """The score of one trained policy: a line of ``experiments.jsonl``.

    Attributes:
        task: Name of the task.
        policy: "mlp", "act" or "diffusion".
        preset: "cpu" or "paper".
        num_train_episodes: Episodes that it was trained on.
        train_seed: Seed of its training.
        steps: Training steps.
        region: Initial region of data and rollouts.
        variant: How its data was generated, a key of ``variants.VARIANTS``.
        variation: How the worlds of its rollouts differed.
        perception: How its rollouts saw objects.
        recipe: Digest of the preset's hyperparameters and the steps.
        stamp: Digest of what generation did with the task.
        policy_type: Type of the policy as LeRobot registers it.
        policy_hash: SHA-256 of everything that decides its actions.
        code: SHA-256 of the code of the simulation, eyes and judge; empty in lines from before that was noted.
        first_seed: Seed of the first rollout.
        episodes: Number of rollouts.
        successes: Rollouts whose success was held for one second.
        successes_end: Rollouts with success at the last step.
        successes_ever: Rollouts with success at some step.
        successes_strict: Rollouts that succeeded strictly; None in lines from before that was judged.
        outcomes: Number of rollouts by outcome.
        data_success_rate: Share of successes in the generation of its data, in [0, 1]; None where unknown.
        rollouts_per_hour: Speed of the rollouts; None where they were read from a file.
        train_s: Wall-clock time of the training [s].
        train_samples_per_s: Samples trained on per second.
        train_device: Where it was trained, as torch calls it.
    """

    task: str
    policy: str
    preset: str
    num_train_episodes: int
    train_seed: int
    steps: int
    region: str
    variant: str
    variation: str = "none"
    perception: str = "exact"
    recipe: str
    stamp: str
    policy_type: str = ""
    policy_hash: str = ""
    code: str = ""
    first_seed: int = 0
    episodes: int
    successes: int
    successes_end: int
    successes_ever: int
    successes_strict: int | None = None
    outcomes: Mapping[str, int] = field(default_factory=dict)
    data_success_rate: float | None = None
    rollouts_per_hour: int | None = None
    train_s: float
    train_samples_per_s: int
    train_device: str = "cpu"

    @property
    def worlds(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Variation and perception of its training data, and of its rollouts."""
        return sight(self.variant), (self.variation, self.perception)

    @property
    def stamp_now(self) -> str:
        """What its ``stamp`` would be if it was measured now."""
        return sight_stamp(self.task, *self.worlds, region=self.region)

    @property
    def is_plain(self) -> bool:
        """Tell whether its rollouts are what the paper's tables count: the plain world, seen exactly."""
        return (self.variation, self.perception) == ("none", "exact")


@dataclass(frozen=True, kw_only=True)
class GenerationResult(Result):
    """The success of generation at one task in one region: a line of ``generation.jsonl``.

    Attributes:
        task: Name of the task.
        region: Initial region.
        seed: Seed of the run.
        attempts: Number of attempts.
        successes: Attempts that succeeded.
        success_rate: Share of attempts that succeeded, in [0, 1].
        outcomes: Number of attempts by outcome.
        first_try_successes: Attempts that succeeded without a retry.
        episode_s: Mean simulated time of a success [s]; None without a success.
        stamp: Digest of what generation did with the task; None in the oldest lines.
        retries: How often an attempt might begin again by ``--retries``; in worlds that vary it may twice in any case.
        command_noise: Scale of the noise that commands carried.
        start_spread: Factor by which the region's ranges of the robot's pose were widened.
        stance_spread: Scale of how far off the robot stood when it began to act on the object.
        variation: How worlds differed.
        perception: How the generator saw objects.
        strict_successes: Attempts that succeeded strictly; None in lines from before that was judged.
    """

    task: str
    region: str
    seed: int = 0
    attempts: int
    successes: int
    strict_successes: int | None = None
    success_rate: float | None = None
    outcomes: Mapping[str, int] = field(default_factory=dict)
    first_try_successes: int | None = None
    episode_s: float | None = None
    stamp: str | None = None
    retries: int = 0
    command_noise: float = 0.0
    start_spread: float = 1.0
    stance_spread: float = 0.0
    variation: str = "none"
    perception: str = "exact"

    @property
    def strict_rate(self) -> float | None:
        """Share of attempts that succeeded strictly, in [0, 1]; None where that was not judged."""
        return None if self.strict_successes is None else self.strict_successes / self.attempts

    @property
    def stamp_now(self) -> str:
        """What its ``stamp`` would be if it was measured now."""
        return stamp(self.task, self.variation, region=self.region)

    @property
    def is_undisturbed(self) -> bool:
        """Tell whether its attempts are what tables count: no noise, no tries beyond the usual ones, exact poses."""
        knobs = (self.retries, self.command_noise, self.start_spread, self.stance_spread, self.perception)
        return knobs == (0, 0.0, 1.0, 0.0, "exact")

    @property
    def is_plain(self) -> bool:
        """Tell whether they are, in the plain world."""
        return self.is_undisturbed and self.variation == "none"


@dataclass(frozen=True, kw_only=True)
class Measurement(Result):
    """What a benchmark found: a line of any other file.

    Attributes:
        values: What the benchmark printed, by name.
    """

    values: Mapping[str, Any]

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401
        """Return one of the values."""
        return self.values[name]

    def get(self, name: str, default: Any = None) -> Any:  # noqa: ANN401
        """Return one of the values, or the default where the line does not have it."""
        return self.values.get(name, default)


def append(path: Path, command: str, result: Result) -> None:
    """Append a result with its command and the commit of the working tree.

    Args:
        path: The ``.jsonl`` file.
        command: What was run.
        result: What it found.
    """
    values = dict(result.values) if isinstance(result, Measurement) else asdict(result)
    append_result(path, command, {name: value for name, value in values.items() if name not in ("command", "commit")})


def read_policies(path: Path) -> list[PolicyResult]:
    """Return the scores of policies in a file, none where it does not exist.

    Raises:
        DatasetError: A line is not a ``PolicyResult``.
    """
    return jsonl.read_as(PolicyResult, path) if path.exists() else []


def read_generation(path: Path) -> list[GenerationResult]:
    """Return the results of generation in a file, none where it does not exist.

    Raises:
        DatasetError: A line is not a ``GenerationResult``.
    """
    return jsonl.read_as(GenerationResult, path) if path.exists() else []


def read_measurements(path: Path) -> list[Measurement]:
    """Return the measurements in a file, none where it does not exist.

    Raises:
        DatasetError: A line is not a JSON object.
    """
    if not path.exists():
        return []
    found = []
    for number, line in enumerate(jsonl.read(path), start=1):
        origin = jsonl.parse(Result, line, f"{path}:{number}")
        values = {name: value for name, value in line.items() if name not in ("command", "commit")}
        found.append(Measurement(values=values, command=origin.command, commit=origin.commit))
    return found


def newest[R: Result](lines: Iterable[R], *keys: str) -> list[R]:
    """Keep the last line of each combination of keys, in the order of the keys' values."""

    def value(line: R, key: str) -> Any:  # noqa: ANN401
        return line.get(key) if isinstance(line, Measurement) else getattr(line, key)

    kept = {tuple(str(value(line, key)) for key in keys): line for line in lines}
    return [kept[key] for key in sorted(kept)]
