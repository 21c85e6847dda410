"""Lines of results -> the paper's three tables with ours beside them, harder worlds and ablations, as Markdown."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from gym_demohlm.task import DEFAULT_REGION, WIDEST
from lerobot_demohlm.experiments import paper
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import PERCEPTIONS, REGIONS
from lerobot_demohlm.experiments.rates import (
    NOTHING,
    TITLES,
    age,
    cell,
    generated,
    group,
    latest,
    markdown,
    marked,
    method_title,
    number,
    of_the_paper,
    steps_title,
    trained_on,
)
from lerobot_demohlm.experiments.variants import VARIANTS
from lerobot_demohlm.policies.presets import POLICIES

VARIANT_NOTES = {
    "noise": "commands are executed with noise and recorded without",
    "starts": "wider starts of the robot",
    "stances": "it acts from places that are a little off",
    "real": "noise, in worlds that vary",
    "model": "noise, with object poses that have the tracker's fitted errors",
}
VARIED = "real"  # the data and the worlds of the tables that are shown first
SHOWN_EPISODES = 1000  # training episodes of the policies in them
NUM_ROLLOUTS = 250
_TRAINING = ("task", "num_train_episodes", "train_seed", "steps", "region", "variant", "recipe", "train_s")
"""What two lines of one training agree in: it may have been scored in several worlds."""


def main_table(lines: Iterable[PolicyResult]) -> str:
    """Return success by the number of training episodes, one row a task; the paper's is ACT."""
    current = of_the_paper(lines)
    cells = group(current, "task", "num_train_episodes", "policy", "preset")
    if not cells:
        return ""
    sizes = sorted({size for _, size, *_ in cells})
    methods = {size: _methods(cells, size) for size in sizes}
    shown = [*sizes, *({paper.SIZES[-1]} - set(sizes))]
    header = ["task"]
    for size in shown:
        header += [f"{size}: {method_title(*method)}" for method in methods.get(size, ())] + [f"paper {size}"]
    rows = []
    for task in dict.fromkeys(task for task, *_ in cells):
        ours = [cell(cells.get((task, size, *method))) for size in sizes for method in methods[size]]
        label, *texts = marked(task, ours)
        row = [label]
        for size in shown:
            count = len(methods.get(size, ()))
            row += [*texts[:count], number(paper.success(task, size))]
            texts = texts[count:]
        rows.append(row)
    title = "**Success by number of training episodes** [%], R3, last checkpoint, starts never used in generation"
    title += "; success held for 1 s (the paper's need not be held; its policy is ACT)"
    return f"{title}\n\n{markdown(header, rows)}"


def architectures_table(lines: Iterable[PolicyResult]) -> str:
    """Return success by policy, for tasks and sizes with more than one of them."""
    current = of_the_paper(lines)
    cells = group(current, "task", "num_train_episodes", "preset", "policy")
    rows = []
    for task, size, preset in dict.fromkeys(key[:3] for key in cells):
        ours = [cells.get((task, size, preset, policy)) for policy in POLICIES]
        if sum(found is not None for found in ours) > 1:
            theirs = paper.SUCCESS_BY_ARCHITECTURE.get(task, {})
            label, *texts = marked(task, [cell(found) for found in ours])
            rows.append([label, str(size), preset, *texts, *(number(theirs.get(policy)) for policy in POLICIES)])
    if not rows:
        return ""
    names = [TITLES[policy] for policy in POLICIES]
    header = ["task", "episodes", "preset", *names, *(f"paper: {name}" for name in names)]
    title = f"**Success by policy** [%], R3; the paper's with {paper.ARCHITECTURE_SIZE} episodes"
    return f"{title}\n\n" + markdown(header, rows)


def by_region(lines: Iterable[GenerationResult], variation: str = "none") -> dict[str, dict[str, GenerationResult]]:
    """Return the last line of each region in order, by task; in plain worlds of tasks with all three of the paper's."""
    own = [line for line in lines if line.is_undisturbed and line.variation == variation]
    last = {(line.task, line.region): line for line in own}
    found = {}
    for task in sorted({task for task, _ in last}):
        regions = {region: last[task, region] for region in (*REGIONS, WIDEST) if (task, region) in last}
        if variation != "none" or all(region in regions for region in REGIONS):
            found[task] = regions
    return found


def regions_table(lines: Sequence[GenerationResult]) -> str:
    """Return the success of generation by region: in plain worlds, for tasks with all three, and in others."""
    parts = []
    for variation in dict.fromkeys(("none", *(line.variation for line in lines))):
        found = by_region(lines, variation)
        shown = [region for region in (*REGIONS, WIDEST) if any(region in regions for regions in found.values())]
        theirs = REGIONS if variation == "none" else ()
        rows = []
        for task, regions in found.items():
            ours = [(generated(regions[name]), age(regions[name])) if name in regions else NOTHING for name in shown]
            rows.append([*marked(task, ours), *(number(paper.GENERATION.get((task, name))) for name in theirs)])
        if rows:
            worlds = "" if variation == "none" else f" in worlds that vary by `{variation}`"
            header = ["task", *shown, *(f"paper: {region}" for region in theirs)]
            parts.append(f"**Generation success by initial region{worlds}** [%]\n\n{markdown(header, rows)}")
    return "\n\n".join(parts)


def variants_table(lines: Iterable[PolicyResult]) -> str:
    """Return success by the way the training data was generated, for what was trained on more than one."""
    lines = [line for line in latest(lines) if line.is_plain]
    cells = group(lines, "task", "policy", "preset", "num_train_episodes", "region", "variant")
    names = [name for name in VARIANTS if any(line.variant == name for line in lines)]
    rows = []
    for key in dict.fromkeys(key[:-1] for key in cells):
        ours = [cells.get((*key, name)) for name in names]
        if sum(found is not None for found in ours) > 1:
            task, policy, preset, size, region = key
            shares = [found[0].data_success_rate if found else None for found in ours]
            generated = [number(None if share is None else 100 * share) for share in shares]
            label, *texts = marked(task, [cell(found) for found in ours])
            rows.append([label, region, method_title(policy, preset), str(size), *texts, *generated])
    if not rows:
        return ""
    header = ["task", "region", "policy", "episodes", *names, *(f"generation: {name}" for name in names)]
    title = "**Success by how the training data was generated** [%], and that of generation"
    notes = [f"{name}: {note}" for name, note in VARIANT_NOTES.items() if name in names]
    return "; ".join([title, *notes]) + "\n\n" + markdown(header, rows)


def worlds_table(lines: Iterable[PolicyResult]) -> str:
    """Return success by how worlds vary and by region, for policies that acted in more than plain worlds."""
    known = latest(lines, any_steps=True)
    exact = [line for line in known if line.perception == "exact" and ":" not in line.variation]
    title = "**Success of policies in worlds that vary** [%]; `noise` is data of plain worlds, `real` of varied ones"

    def worlds(line: PolicyResult) -> str:
        return f"{line.region}, `{line.variation}`"

    def trained(line: PolicyResult) -> tuple[str, str, str, int, int, str]:
        return line.task, line.policy, line.preset, line.steps, line.num_train_episodes, line.variant

    tried = {trained(line) for line in exact if line.variation != "none"}
    chosen = [line for line in exact if trained(line) in tried]
    return _compared(title, chosen, worlds, sorted({worlds(line) for line in chosen}))


def perception_table(lines: Iterable[PolicyResult]) -> str:
    """Return success by how objects are seen, for policies that saw them in more than one way."""
    plain = [line for line in latest(lines) if line.variation == "none"]
    title = "**Success of policies by how they see objects** [%]; `model` is data with errors of a fitted model"
    named = {line.perception for line in plain if line.perception != "exact"}
    names = [name for name in PERCEPTIONS if name in named] + sorted(named - set(PERCEPTIONS))
    return _compared(title, plain, lambda line: f"`{line.perception}`", [f"`{name}`" for name in names], "`exact`")


def perception_counts(lines: Iterable[PolicyResult]) -> str:
    """Return strict successes by how objects are seen, of policies of worlds that vary which saw them in several ways.

    Those of the first seed and of a thousand episodes, in plain worlds and R3.
    """
    wanted = (VARIED, "none", DEFAULT_REGION, "cpu", SHOWN_EPISODES, 0)
    keys = ("variant", "variation", "region", "preset", "num_train_episodes", "train_seed")
    chosen = [line for line in latest(lines) if tuple(getattr(line, key) for key in keys) == wanted]
    rows = []
    for (task, policy, device), found in group(chosen, "task", "policy", "train_device").items():
        cells = {name: [line for line in found if line.perception == name] for name in PERCEPTIONS}
        if sum(map(bool, cells.values())) > 1:
            counts = ["".join(cell(ours, _strict_count)) for ours in cells.values()]
            rows.append([task, method_title(policy, "cpu", device), *counts])
    return markdown(["task", "policy", *(f"`{name}`" for name in PERCEPTIONS)], rows)


def _strict_count(lines: Sequence[PolicyResult]) -> str:
    """Return how often the policy of one line succeeded strictly, and out of how many where it is not 250."""
    count, episodes = lines[0].successes_strict, lines[0].episodes
    return "-" if count is None else f"{count}" + ("" if episodes == NUM_ROLLOUTS else f" of {episodes}")


def _compared(
    title: str,
    lines: Sequence[PolicyResult],
    column: Callable[[PolicyResult], str],
    wanted: Sequence[str],
    first: str | None = None,
) -> str:
    """Return a table of policies against columns, for those with a line in one of the wanted ones."""
    keys = ("task", "policy", "preset", "steps", "train_device", "num_train_episodes", "variant")
    keys += ("region",) if first else ()
    rows = []
    columns = [*([first] if first else []), *wanted]
    for key, found in group(lines, *keys).items():
        cells = {name: [line for line in found if column(line) == name] for name in columns}
        if any(cells[name] for name in wanted):
            task, policy, preset, _, device, size, variant, *region = key
            named = [task, *region, method_title(policy, preset, device) + steps_title(found[0]), str(size), variant]
            rows.append([*named, *("".join(cell(cells[name])) for name in columns)])
    if not rows:
        return ""
    header = ["task", *(["region"] if first else []), "policy", "episodes", "data", *columns]
    return f"{title}\n\n" + markdown(header, rows)


def cost_table(lines: Iterable[PolicyResult]) -> str:
    """Return what the trainings and the rollouts took."""
    rows = []
    for (policy, preset, device), found in group(latest(lines), "policy", "preset", "train_device").items():
        hours = [line.rollouts_per_hour for line in found if line.rollouts_per_hour]
        trainings = {tuple(getattr(line, key) for key in _TRAINING): line for line in found}.values()
        rows.append(
            [
                f"{TITLES[policy]}, {preset}" + trained_on(device),
                str(len(trainings)),
                f"{np.median([line.train_s for line in trainings]) / 60:.1f} min",
                f"{np.median([line.train_samples_per_s for line in trainings]):.0f}",
                f"{np.median(hours):.0f}" if hours else "-",
            ]
        )
    header = ["policy", "trainings", "a training", "samples/s", "rollouts/h"]
    title = "**Time of the experiments**, medians of wall-clock time with whatever ran beside, one core each"
    return f"{title}\n\n" + markdown(header, rows)


def experiments_tables(lines: Sequence[PolicyResult]) -> str:
    """Return every table that lines of ``experiments.jsonl`` fill."""
    usual = [line for line in lines if line.region == DEFAULT_REGION]
    parts = [main_table(usual), architectures_table(usual)]
    parts += [worlds_table(lines), perception_table(lines), variants_table(lines), cost_table(lines)]
    return "\n\n".join(part for part in parts if part)


def _methods(cells: Iterable[tuple[Any, ...]], size: int) -> list[tuple[str, str]]:
    found = {(policy, preset) for _, count, policy, preset in cells if count == size}
    return sorted(found, key=lambda method: (POLICIES.index(method[0]), method[1]))
