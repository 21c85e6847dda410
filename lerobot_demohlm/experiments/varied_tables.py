"""Lines of results -> strict success in worlds that vary: the README's table, those of R4, and comparisons."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from scipy.stats import fisher_exact

from gym_demohlm.task import DEFAULT_REGION, WIDEST
from lerobot_demohlm.experiments import paper
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult, read_generation, read_policies
from lerobot_demohlm.experiments.plan import REGIONS
from lerobot_demohlm.experiments.rates import (
    EARLIER,
    TITLES,
    age,
    group,
    latest,
    markdown,
    number,
    steps_title,
    strict_rate,
    trained_on,
)
from lerobot_demohlm.experiments.tables import SHOWN_EPISODES, VARIED
from lerobot_demohlm.experiments.variants import DEFAULT_VARIANT
from lerobot_demohlm.policies.presets import POLICIES

METHODS = ("generation", *(TITLES[policy] for policy in POLICIES))
"""What succeeds in worlds that vary, a column each."""

Cell = tuple[float | None, str]
"""A rate in [0, 1], None where it was not measured, and what stands behind it when it is of an earlier version."""

NOTHING: Cell = (None, "")


def readme_table(results: Path) -> str:
    """Return the README's table: success of generation, and of each policy in worlds that vary, and the paper's.

    Args:
        results: Folder of JSON lines.
    """
    attempted = _attempted(results, DEFAULT_REGION, "none")
    plain = {task: (made.successes / made.attempts, age(made)) for task, made in attempted.items()}
    varied, rollouts = _varied(results, DEFAULT_REGION)
    rows = {
        task: [plain.get(task, NOTHING), *varied.get(task, [NOTHING] * len(METHODS))] for task in _tasks(plain, varied)
    }
    theirs = {
        task: [number(paper.GENERATION.get((task, DEFAULT_REGION))), number(paper.success(task, paper.SIZES[-1]))]
        for task in rows
    }
    attempts = " or ".join(map(str, sorted({made.attempts for made in attempted.values()}))) or "no"
    text = (
        f"Success [%] in [R3](docs/benchmark.md#ranges). Generation: {attempts} attempts, without the noise in the "
        f"commands that datasets have by default, in plain worlds, and in [`{VARIED}`](docs/variation.md) ones, where "
        f"objects, robot, surroundings and pushes differ from attempt to attempt and the robot may try twice more. "
        f"Policies: {rollouts} rollouts in `{VARIED}` worlds, after training on {SHOWN_EPISODES} episodes of them; a "
        f"mean where several seeds were trained. In `{VARIED}` worlds success is [strict](docs/benchmark.md#success)."
    )
    header = ["task", "generation", *(f"{name}, `{VARIED}`" for name in METHODS)]
    header += ["paper: generation", "paper: ACT, 5000 episodes"]
    table = markdown(header, _with_means(rows, theirs))
    if EARLIER in table:
        text += " An earlier version is one from before the task's demonstration, or what generates from it, changed."
    return f"{text}\n\n{table}"


def widest_table(results: Path) -> str:
    """Return strict success [%] of generation and of each policy in R4, in worlds that vary.

    Args:
        results: Folder of JSON lines.
    """
    rows, _ = _varied(results, WIDEST)
    return markdown(["task", *METHODS], _with_means(rows))


def generation_table(results: Path) -> str:
    """Return strict success [%] of generation by region, in plain worlds and in those that vary: least and mean.

    Args:
        results: Folder of JSON lines.
    """
    rows = []
    for variation, region in product(("none", VARIED), (*REGIONS, WIDEST)):
        made = _attempted(results, region, variation)
        cells = {task: (rate, age(line)) for task, line in made.items() if (rate := line.strict_rate) is not None}
        if cells:
            least, mean = min(cells.values()), _mean(list(cells.values()))
            rows.append([f"`{variation}`", region, str(len(cells)), _shown(*least), _shown(*mean)])
    return markdown(["worlds", "region", "tasks", "least", "mean"], rows)


def sizes_table(results: Path) -> str:
    """Return strict success [%] in R4, in worlds that vary, by the number of training episodes.

    Trainings of other numbers of steps than the preset's have rows of their own.

    Args:
        results: Folder of JSON lines.
    """
    scored = _scored(results, WIDEST, any_steps=True)
    sizes = sorted({line.num_train_episodes for line in scored})
    rows = []
    for (task, policy, _), found in group(scored, "task", "policy", "steps").items():
        cells = group(found, "num_train_episodes")
        if len(cells) > 1:
            method = TITLES[policy] + steps_title(found[0])
            rows.append([task, method, *(_shown(*_cell(cells.get((size,), []))) for size in sizes)])
    return markdown(["task", "policy", *(f"{size} episodes" for size in sizes)], rows)


def steps_table(results: Path) -> str:
    """Return strict success [%] in worlds that vary by the number of training steps, where several were tried.

    The last column is Fisher's exact test of the shortest training against the longest that it can be compared with.
    Below them are the means of all tasks: each counts with its longest training of at most as many steps.

    Args:
        results: Folder of JSON lines.
    """
    trainings = {
        key: {steps: lines for (steps,), lines in group(found, "steps").items()}
        for key, found in group(_shown_scores(results, any_steps=True), "region", "policy", "task").items()
    }
    several = {key: by_steps for key, by_steps in trainings.items() if len(by_steps) > 1}
    columns = sorted({steps for by_steps in several.values() for steps in by_steps})
    rows = []
    for (region, policy, task), by_steps in several.items():
        rates = [_shown(*_cell(by_steps.get(steps, []))) for steps in columns]
        tested = [_chance(by_steps[min(by_steps)], by_steps[steps]) for steps in sorted(by_steps, reverse=True)[:-1]]
        rows.append([task, region, TITLES[policy], *rates, next((p for p in tested if p != "-"), "-")])
    tasks = dict.fromkeys(task for _, _, task in trainings)
    for region, policy in dict.fromkeys((region, policy) for region, policy, _ in several):
        of_tasks = [trainings.get((region, policy, task), {}) for task in tasks]
        tried = {steps for by_steps in of_tasks for steps in by_steps}
        means = [_mean([_cell(_longest(by_steps, steps)) for by_steps in of_tasks]) for steps in columns]
        shown = [_shown(*mean) if steps in tried else "-" for steps, mean in zip(columns, means, strict=True)]
        rows.append([f"mean of {len(tasks)} tasks", region, TITLES[policy], *shown, "-"])
    return markdown(["task", "region", "policy", *(f"{steps:,} steps" for steps in columns), "p"], rows)


def seeds_table(results: Path) -> str:
    """Return strict success [%] in worlds that vary of each training of the cells that were trained more than once.

    Args:
        results: Folder of JSON lines.
    """
    rows = []
    for (region, policy, task), found in group(_shown_scores(results), "region", "policy", "task").items():
        if len(found) > 1:
            found = sorted(found, key=lambda line: line.train_seed)
            rates = [_shown(*_cell([line])) + trained_on(line.train_device) for line in found]
            rows.append([task, region, TITLES[policy], ", ".join(rates)])
    return markdown(["task", "region", "policy", "each training"], rows)


def plain_data_table(results: Path) -> str:
    """Return strict success [%] in R3 in worlds that vary of policies of plain data, and beside it of varied data.

    Args:
        results: Folder of JSON lines.
    """
    plain = _scored(results, DEFAULT_REGION, variant=DEFAULT_VARIANT)
    varied = group(_scored(results, DEFAULT_REGION), "task", "policy", "num_train_episodes")
    rows = [
        [key[0], TITLES[key[1]], _shown(*_cell(found)), _shown(*_cell(varied.get(key, [])))]
        for key, found in group(plain, "task", "policy", "num_train_episodes").items()
        if key[2] == SHOWN_EPISODES
    ]
    return markdown(["task", "policy", "of plain data", f"of `{VARIED}` data"], rows)


def _shown_scores(results: Path, *, any_steps: bool = False) -> list[PolicyResult]:
    """Return the scores in R3 and R4 of policies of as many episodes of worlds that vary as tables show."""
    found = [line for region in (DEFAULT_REGION, WIDEST) for line in _scored(results, region, any_steps=any_steps)]
    return [line for line in found if line.num_train_episodes == SHOWN_EPISODES]


def _longest(by_steps: Mapping[int, list[PolicyResult]], steps: int) -> list[PolicyResult]:
    """Return the lines of the longest training that has at most these steps; an empty list where each has more."""
    return by_steps.get(max((found for found in by_steps if found <= steps), default=0), [])


def _chance(first: Sequence[PolicyResult], second: Sequence[PolicyResult]) -> str:
    """Return how likely chance makes such a difference of strict successes.

    A dash where their data differ in age, or where one was trained on a GPU and the other was not.
    """
    if len({(line.stamp, line.train_device) for line in (*first, *second)}) > 1:
        return "-"
    table = []
    for lines in (first, second):
        successes = sum(line.successes_strict or 0 for line in lines)
        table.append([successes, sum(line.episodes for line in lines) - successes])
    tested: Any = fisher_exact(table)
    return "below 0.001" if tested.pvalue < 0.001 else f"{tested.pvalue:.3f}"


def _scored(results: Path, region: str, *, variant: str = VARIED, any_steps: bool = False) -> list[PolicyResult]:
    """Return the scores of policies of one kind of data in worlds that vary, by the `cpu` presets, in one region."""
    wanted = (variant, VARIED, "exact", region, "cpu")
    keys = ("variant", "variation", "perception", "region", "preset")
    lines = latest(read_policies(results / "experiments.jsonl"), any_steps=any_steps)
    return [line for line in lines if tuple(getattr(line, key) for key in keys) == wanted]


def _attempted(results: Path, region: str, variation: str) -> dict[str, GenerationResult]:
    """Return the last line of generation of each task in one region and one kind of worlds."""
    lines = [line for line in read_generation(results / "generation.jsonl") if line.is_undisturbed]
    return {line.task: line for line in lines if (line.region, line.variation) == (region, variation)}


def _varied(results: Path, region: str) -> tuple[dict[str, list[Cell]], str]:
    """Return strict success in worlds that vary of each task, of generation and each policy, and how many rollouts."""
    scored = [line for line in _scored(results, region) if line.num_train_episodes == SHOWN_EPISODES]
    attempted, cells = _attempted(results, region, VARIED), group(scored, "task", "policy")
    found = {}
    for task in _tasks(attempted, dict.fromkeys(task for task, _ in cells)):
        made = attempted.get(task)
        row = [_cell(cells.get((task, policy), [])) for policy in POLICIES]
        found[task] = [NOTHING if made is None else (made.strict_rate, age(made)), *row]
    return found, " or ".join(map(str, sorted({line.episodes for line in scored}))) or "no"


def _cell(lines: Sequence[PolicyResult]) -> Cell:
    """Return strict success of one cell's lines, one a training seed."""
    return (strict_rate(lines), max(map(age, lines))) if lines else NOTHING


def _tasks(*by_task: Mapping[str, object]) -> list[str]:
    """Return the paper's tasks, in its order, then others."""
    return list(dict.fromkeys([*paper.SUCCESS_BY_SIZE, *sorted({task for found in by_task for task in found})]))


def _with_means(
    rows: Mapping[str, Sequence[Cell]], beside: Mapping[str, Sequence[str]] | None = None
) -> list[list[str]]:
    """Return the cells of a table, a row a task, and the means of those columns that have every task.

    Args:
        rows: Cells by task.
        beside: What else stands in the row of each task.
    """
    beside = beside or {task: () for task in rows}
    shown = [[task, *(_shown(*cell) for cell in cells), *beside[task]] for task, cells in rows.items()]
    means = [_shown(*_mean(column)) for column in zip(*rows.values(), strict=True)]
    return [*shown, ["mean", *means, *("-" for _ in next(iter(beside.values())))]]


def _mean(cells: Sequence[Cell]) -> Cell:
    """Return the mean of all cells, of an earlier version where one of them is; nothing where one was not measured."""
    rates = [rate for rate, _ in cells if rate is not None]
    return (sum(rates) / len(rates), max(text for _, text in cells)) if len(rates) == len(cells) else NOTHING


def _shown(rate: float | None, aged: str) -> str:
    """Return a rate as a percentage and whether it is of an earlier version; a dash where there is none."""
    return "-" if rate is None else f"{100 * rate:.1f}{aged}"
