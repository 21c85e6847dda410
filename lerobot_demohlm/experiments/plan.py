"""A table of the paper, tasks, sizes and seeds -> the cells to run, every task's first before any task's second."""

import functools
import hashlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gym_demohlm.errors import PolicyError, UnknownNameError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.task import DEFAULT_REGION
from lerobot_demohlm.checks import portability
from lerobot_demohlm.datasets import variation
from lerobot_demohlm.datasets.variation import DataVariation
from lerobot_demohlm.policies.presets import POLICIES, get_preset

REGIONS = ("R1", "R2", "R3")
FIRST_TASKS = {"architectures": ("GraspCube", "Handover", "LiftBox"), "regions": ("GraspCube", "Handover")}
"""Tasks of a table where none are named; all of them where it is not listed."""
_SIZES = {"main": (1000, 100), "architectures": (1000,)}
_SEEDS = {"main": (0, 1), "architectures": (0,)}
TABLES = ("main", "architectures", "regions")
PLAIN = "plain"  # what lines without a variant are of, and what the table of regions counts
DEFAULT_VARIANT = "noise"  # what policies are trained on: the best in the ablation
VARIANTS: Mapping[str, DataVariation] = {
    PLAIN: variation.PLAIN,
    "noise": DataVariation(command_noise=1.0),
    "starts": DataVariation(command_noise=0.0, start_spread=1.3),
    "stances": DataVariation(command_noise=0.0, stance_spread=1.0),
    "noise_stances": DataVariation(command_noise=1.0, stance_spread=1.0),
}
"""Ways to generate training data, each said in full; rollouts are the same for all of them."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One trained policy and its score.

    Attributes:
        task: Name of the task.
        policy: "mlp", "act" or "diffusion".
        preset: "cpu" or "paper".
        num_train_episodes: Episodes it is trained on, the first of its task's dataset.
        train_seed: Of weights and order of samples.
        steps: Training steps.
        region: Initial region of data and rollouts.
        variant: How its data is generated, a key of ``VARIANTS``.
    """

    task: str
    policy: str
    preset: str
    num_train_episodes: int
    train_seed: int
    steps: int
    region: str = DEFAULT_REGION
    variant: str = DEFAULT_VARIANT

    def __post_init__(self) -> None:
        """Check names and numbers."""
        get_task(self.task).region(self.region)
        get_preset(self.policy, self.preset)
        if self.variant not in VARIANTS:
            raise UnknownNameError("variant", self.variant, VARIANTS)
        if self.num_train_episodes < 1 or self.train_seed < 0 or self.steps < 1:
            raise PolicyError(
                f"num_train_episodes={self.num_train_episodes}, train_seed={self.train_seed}, steps={self.steps}",
                "one episode and step or more, and a seed of 0 or more",
                "correct --sizes, --seeds or --steps",
            )

    @property
    def name(self) -> str:
        """Return what its directory is called."""
        parts = (self.policy, self.preset, self.num_train_episodes, self.region.lower(), f"seed{self.train_seed}")
        return "_".join(map(str, (get_task(self.task).slug, *parts, *_suffix(self.variant))))

    @property
    def recipe(self) -> str:
        """Return eight letters that change with the preset's hyperparameters and the steps."""
        return _digest(get_preset(self.policy, self.preset), self.steps)

    def is_of(self, line: dict[str, Any]) -> bool:
        """Tell whether a line of results is this cell's, as the cell would be made now."""
        mine = {**asdict(self), "recipe": self.recipe, "stamp": stamp(self.task)}
        return {key: line.get(key) for key in mine} == mine


@dataclass(frozen=True, kw_only=True)
class RegionCell:
    """The success rate of generation in one region.

    Attributes:
        task: Name of the task.
        region: Initial region.
    """

    task: str
    region: str

    def is_of(self, line: dict[str, Any]) -> bool:
        """Tell whether a line of results is this cell's, as the cell would be made now."""
        mine = (self.task, self.region, stamp(self.task))
        return is_plain(line) and (line.get("task"), line.get("region"), line.get("stamp")) == mine


def is_plain(line: dict[str, Any]) -> bool:
    """Tell whether a line of ``generation.jsonl`` is of attempts as tables count them: nothing disturbed, one try."""
    return DataVariation.read(line) == variation.PLAIN


def _suffix(variant: str) -> tuple[str, ...]:
    """Return what the names of files say of a variant."""
    return () if variant == PLAIN else (variant,)


def _stem(task: str, region: str, variant: str = PLAIN) -> str:
    """Return what the names of datasets begin with."""
    return "_".join((get_task(task).slug, region.lower(), *_suffix(variant), stamp(task)))


def _digest(*parts: object) -> str:
    return hashlib.sha256("".join(map(str, parts)).encode()).hexdigest()[:8]


@functools.cache
def stamp(task: str) -> str:
    """Return eight letters that change with what generation does with a task, wherever its code stands."""
    return portability.stamp(get_task(task))


def plan(
    table: str,
    *,
    preset: str = "cpu",
    tasks: Sequence[str] | None = None,
    sizes: Sequence[int] | None = None,
    seeds: Sequence[int] | None = None,
    policies: Sequence[str] | None = None,
    variants: Sequence[str] | None = None,
    steps: int | None = None,
) -> list[Cell] | list[RegionCell]:
    """Return the cells of a table, each once: a round goes through all tasks before the next begins.

    Args:
        table: "main", "architectures" or "regions".
        preset: "cpu" or "paper".
        tasks: Names; the table's by default.
        sizes: Numbers of training episodes, the first wanted first; the table's by default.
        seeds: Of the trainings; the table's by default.
        policies: The table's by default: main trains the MLP everywhere, and ACT once at the largest size.
        variants: Of the training data; more than one, for an ablation, are run in turn.
        steps: Training steps; each preset's by default.

    Raises:
        UnknownNameError: No such table, task, policy, preset or variant.
    """
    if table not in TABLES:
        raise UnknownNameError("table", table, TABLES)
    names = list(dict.fromkeys(get_task(name).name for name in (tasks or FIRST_TASKS.get(table) or all_tasks())))
    if table == "regions":
        return [RegionCell(task=task, region=region) for region in reversed(REGIONS) for task in names]
    rounds = _rounds(table, sizes or _SIZES[table], _SEEDS[table] if seeds is None else seeds, policies)
    cells = [
        Cell(
            task=task,
            policy=policy,
            preset=preset,
            num_train_episodes=size,
            train_seed=seed,
            steps=get_preset(policy, preset).steps if steps is None else steps,
            variant=variant,
        )
        for policy, size, seed in rounds
        for variant in variants or (DEFAULT_VARIANT,)
        for task in names
    ]
    return list(dict.fromkeys(cells))


def _rounds(
    table: str, sizes: Sequence[int], seeds: Sequence[int], policies: Sequence[str] | None
) -> Iterable[tuple[str, int, int]]:
    """Yield (policy, size, seed), the most wanted first, each once."""
    if table == "main" and policies is None:
        first = [("mlp", size, seeds[0]) for size in sizes] + [("act", max(sizes), seeds[0])]
        return first + [("mlp", size, seed) for seed in seeds[1:] for size in sizes]
    return [(policy, size, seed) for seed, size, policy in itertools.product(seeds, sizes, policies or POLICIES)]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where a run of experiments keeps what.

    Attributes:
        root: Directory of everything large: datasets, trainings, rollouts.
        results: Directory of the lines that are kept.
    """

    root: Path
    results: Path

    @property
    def policies_file(self) -> Path:
        """Return where the score of each cell goes."""
        return self.results / "experiments.jsonl"

    @property
    def generation_file(self) -> Path:
        """Return where the success of generation goes."""
        return self.results / "generation.jsonl"

    def dataset(self, task: str, region: str, size: int, variant: str = PLAIN) -> Path:
        """Return the smallest dataset there is with so many episodes, or where to make one."""
        held = self.datasets(task, region, variant)
        sizes = {count: path for path, count in held.items() if count >= size}
        return sizes[min(sizes)] if sizes else self.root / "data" / f"{_stem(task, region, variant)}_{size}"

    def datasets(self, task: str, region: str, variant: str = PLAIN) -> dict[Path, int]:
        """Return the datasets that there are, and how many episodes each has."""
        found = (self.root / "data").glob(f"{_stem(task, region, variant)}_*[0-9]")
        return {path: int(path.name.rpartition("_")[2]) for path in sorted(found)}

    def generation(self, cell: RegionCell, num_attempts: int) -> Path:
        """Return where the attempts of a region are made."""
        return self.root / "regions" / f"{_stem(cell.task, cell.region)}_{num_attempts}"

    def training(self, cell: Cell) -> Path:
        """Return where a cell is trained."""
        return self.root / "policies" / f"{cell.name}_{stamp(cell.task)}_{cell.recipe}"

    def rollouts(self, cell: Cell) -> Path:
        """Return where a cell's rollouts are, one line each."""
        return self.root / "rollouts" / f"{cell.name}_{stamp(cell.task)}_{cell.recipe}.jsonl"
