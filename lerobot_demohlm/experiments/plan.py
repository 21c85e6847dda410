"""A table, of the paper or of harder worlds, -> the cells to run, every task's first before any task's second."""

import functools
import hashlib
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

from gym_demohlm.errors import PolicyError, UnknownNameError
from gym_demohlm.perception import masks
from gym_demohlm.perception.meshes import object_meshes
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.scene import build_scene
from gym_demohlm.task import DEFAULT_REGION, SCORING_SEEDS, WIDEST
from gym_demohlm.variation import get_variation
from gym_demohlm.variation.factors import GROUPS
from lerobot_demohlm.datasets.floors import RANGE_FLOOR
from lerobot_demohlm.evaluation.scoring import first_seed
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.variants import DEFAULT_VARIANT, PLAIN, VARIANTS, sight, sight_stamp, stamp
from lerobot_demohlm.policies.presets import POLICIES, get_preset

REGIONS = ("R1", "R2", "R3")
"""The paper's."""
GRADED = "hard"
STRENGTHS = (0.5, 1.0, 1.5)
PERCEPTIONS = ("exact", "rgbd", "model", "rgbd,masks=color", "apriltag")


def graded(group: str | None, strength: float) -> str:
    """Return the name of the variation of one group at a strength; without a group, of the plain world."""
    return "none" if group is None else f"{GRADED}@{strength:g}:{group}"


@dataclass(frozen=True, kw_only=True)
class Grid:
    """What a table has a cell for each combination of.

    Attributes:
        tasks: Names; none for all in the package.
        sizes: Numbers of training episodes, the first wanted first.
        seeds: Of the trainings.
        policies: Which are trained.
        variants: How their data is generated, keys of ``VARIANTS``.
        regions: Of data, rollouts and attempts.
        variations: How the worlds of rollouts or attempts differ.
        perceptions: How rollouts see objects.
    """

    tasks: Sequence[str] = ()
    sizes: Sequence[int] = (1000,)
    seeds: Sequence[int] = (0,)
    policies: Sequence[str] = POLICIES
    variants: Sequence[str] = (DEFAULT_VARIANT,)
    regions: Sequence[str] = (DEFAULT_REGION,)
    variations: Sequence[str] = ("none",)
    perceptions: Sequence[str] = ("exact",)


_GRIDS = {
    "main": Grid(sizes=(1000, 100), seeds=(0, 1)),
    "architectures": Grid(tasks=("GraspCube", "Handover", "LiftBox")),
    "regions": Grid(regions=(*reversed(REGIONS), WIDEST), variations=("none", "real")),
    "worlds": Grid(seeds=(0, 1), variants=("real", DEFAULT_VARIANT), regions=("R3", WIDEST), variations=("real",)),
    "perception": Grid(policies=("mlp", "act"), variants=(DEFAULT_VARIANT, "model"), perceptions=PERCEPTIONS),
    "robustness": Grid(
        policies=("act",),
        variants=("real",),
        variations=("none", *(graded(group, strength) for group in GROUPS for strength in STRENGTHS)),
    ),
}
TABLES = tuple(_GRIDS)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One trained policy and its score.

    Attributes:
        task: Name of the task.
        policy: "mlp", "act" or "diffusion".
        preset: Of its hyperparameters; one that sees trains on colour pictures instead of poses.
        num_train_episodes: Episodes it is trained on, the first of its task's dataset.
        train_seed: Of weights and order of samples.
        steps: Training steps.
        region: Initial region of data and rollouts.
        variant: How its data is generated, a key of ``VARIANTS``.
        variation: How the worlds of its rollouts differ.
        perception: How its rollouts see objects.
    """

    task: str
    policy: str
    preset: str
    num_train_episodes: int
    train_seed: int
    steps: int
    region: str = DEFAULT_REGION
    variant: str = DEFAULT_VARIANT
    variation: str = "none"
    perception: str = "exact"

    def __post_init__(self) -> None:
        """Check names and numbers."""
        get_task(self.task).region(self.region)
        get_preset(self.policy, self.preset)
        if self.variant not in VARIANTS:
            raise UnknownNameError("variant", self.variant, VARIANTS)
        object.__setattr__(self, "variation", get_variation(self.variation).name)
        object.__setattr__(self, "perception", str(PerceptionSettings.read(self.perception)))
        if self.num_train_episodes < 1 or self.train_seed < 0 or self.steps < 1:
            raise PolicyError(
                f"num_train_episodes={self.num_train_episodes}, train_seed={self.train_seed}, steps={self.steps}",
                "one episode and step or more, and a seed of 0 or more",
                "correct --sizes, --seeds or --steps",
            )

    @property
    def sees(self) -> bool:
        """Tell whether it is trained on pictures."""
        return get_preset(self.policy, self.preset).sees

    @property
    def trained(self) -> str:
        """Return what the directory of its training is called; cells that differ in their rollouts only share it."""
        parts = (self.policy, self.preset, self.num_train_episodes, self.region.lower(), f"seed{self.train_seed}")
        return "_".join(map(str, (get_task(self.task).slug, *parts, *suffix(self.variant))))

    @property
    def name(self) -> str:
        """Return what its rollouts are called."""
        return "_".join((self.trained, *suffix(self.variation, "none"), *suffix(self.perception, "exact")))

    @property
    def first_seed(self) -> int:
        """Return the seed of its first rollout; each further one has the next."""
        return first_seed(self.task, self.region)

    @property
    def data_stamp(self) -> str:
        """Return letters that change with what generation makes of its training data."""
        return sight_stamp(self.task, sight(self.variant), region=self.region)

    @property
    def stamp(self) -> str:
        """Return letters that change with what generation makes of its training data, and with its worlds."""
        return sight_stamp(self.task, sight(self.variant), (self.variation, self.perception), region=self.region)

    @property
    def recipe(self) -> str:
        """Return eight letters that change with the preset's hyperparameters and the steps."""
        preset = get_preset(self.policy, self.preset)
        ranges = "MIN_MAX" in preset.options.get("normalization_mapping", {}).values()
        return _digest(preset, self.steps, *([RANGE_FLOOR] if ranges else []))

    def is_of(self, result: PolicyResult) -> bool:
        """Tell whether a result is this cell's, as the cell would be made now."""
        mine = {**asdict(self), "recipe": self.recipe, "stamp": self.stamp, "first_seed": self.first_seed}
        return {key: getattr(result, key) for key in mine} == mine


@dataclass(frozen=True, kw_only=True)
class RegionCell:
    """The success rate of generation in one region.

    Attributes:
        task: Name of the task.
        region: Initial region.
        variation: How worlds differ.
        seed: Of the attempts, by default one that is kept for scoring: they start elsewhere in each task and region.
    """

    task: str
    region: str
    variation: str = "none"
    seed: int = SCORING_SEEDS.start

    def __post_init__(self) -> None:
        """Check names."""
        get_task(self.task).region(self.region)
        object.__setattr__(self, "variation", get_variation(self.variation).name)

    @property
    def stamp(self) -> str:
        """Return letters that change with what generation does in its worlds."""
        return stamp(self.task, self.variation, region=self.region)

    def is_of(self, result: GenerationResult) -> bool:
        """Tell whether a result is this cell's, as the cell would be made now."""
        mine = {**asdict(self), "stamp": self.stamp}
        return result.is_undisturbed and {key: getattr(result, key) for key in mine} == mine


def suffix(name: str, plain: str = PLAIN) -> tuple[str, ...]:
    """Return what the names of files say of a variant, a variation or a perception; nothing of the plain one."""
    return () if name == plain else (re.sub("[^a-z0-9.]+", "-", name),)


def _digest(*parts: object) -> str:
    return hashlib.sha256("".join(map(str, parts)).encode()).hexdigest()[:8]


def plan(
    table: str, *, preset: str = "cpu", steps: int | None = None, **chosen: Sequence[int] | Sequence[str] | None
) -> list[Cell] | list[RegionCell]:
    """Return the cells of a table, each once: a round goes through all tasks before the next begins.

    Masks by colour are left out of tasks with grey objects, which refuse them.

    Args:
        table: One of ``TABLES``.
        preset: "cpu" or "paper".
        steps: Training steps; each preset's by default.
        chosen: Fields of ``Grid`` in place of the table's; None for the table's. By default the main table trains the
            MLP everywhere, and ACT once at the largest size.

    Raises:
        UnknownNameError: No such table, task, region, policy, preset, variant, variation or perception.
        PolicyError: What concerns policies is chosen for the table of regions.
    """
    if table not in TABLES:
        raise UnknownNameError("table", table, TABLES)
    grid = replace(_GRIDS[table], **{name: values for name, values in chosen.items() if values is not None})
    names = list(dict.fromkeys(get_task(name).name for name in grid.tasks or all_tasks()))
    if table == "regions":
        idle = [name for name in ("sizes", "seeds", "policies", "variants", "perceptions") if chosen.get(name)]
        idle += [name for name, given in (("steps", steps is not None), ("preset", preset != "cpu")) if given]
        if idle:
            name = idle[0]
            raise PolicyError(f"{name} for the table of regions", "options of generation", f"leave --{name} out")
        found = (
            RegionCell(task=task, region=region, variation=variation)
            for variation in grid.variations
            for region in grid.regions
            for task in names
        )
        return list(dict.fromkeys(found))
    mixed = table == "main" and chosen.get("policies") is None
    cells = [
        Cell(
            task=task,
            policy=policy,
            preset=preset,
            num_train_episodes=size,
            train_seed=seed,
            steps=get_preset(policy, preset).steps if steps is None else steps,
            region=region,
            variant=variant,
            variation=variation,
            perception=perception,
        )
        for policy, size, seed in (_main_rounds(grid) if mixed else _rounds(grid))
        for region, variant in itertools.product(grid.regions, grid.variants)
        for variation, perception in itertools.product(grid.variations, grid.perceptions)
        for task in names
        if PerceptionSettings.read(perception).masks != "color" or not _has_grey(task)
    ]
    return list(dict.fromkeys(cells))


@functools.cache
def _has_grey(task: str) -> bool:
    """Tell whether masks by colour cannot find each object of a task."""
    return bool(masks.grey(object_meshes(build_scene(get_task(task)).model, get_task(task))))


def _rounds(grid: Grid) -> Iterable[tuple[str, int, int]]:
    """Yield (policy, size, seed), the most wanted first."""
    return [(policy, size, seed) for seed, size, policy in itertools.product(grid.seeds, grid.sizes, grid.policies)]


def _main_rounds(grid: Grid) -> Iterable[tuple[str, int, int]]:
    """Yield the same for the main table: ACT once only, which takes as long as all the others."""
    first = [("mlp", size, grid.seeds[0]) for size in grid.sizes] + [("act", max(grid.sizes), grid.seeds[0])]
    return first + [("mlp", size, seed) for seed in grid.seeds[1:] for size in grid.sizes]
