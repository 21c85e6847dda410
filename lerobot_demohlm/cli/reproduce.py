"""``demohlm reproduce``."""

import json
import math
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from gym_demohlm.errors import DatasetError, DemoHLMError
from lerobot_demohlm.cli.choices import Policy, Preset, Table, Variant
from lerobot_demohlm.cli.parsing import default, spelled

# Options of no concern to what comes out.
_UNSAID = ("num_workers", "data_workers", "budget_hours", "root", "results", "dry_run")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm reproduce``.

    Attributes:
        table: Which table: the paper's (main, architectures, regions), or of worlds that vary, of eyes that err, or of
            policies against each group of a variation.
        tasks: Names of tasks.
        sizes: Numbers of training episodes, most wanted first.
        seeds: Seeds of the trainings.
        policies: Policies to train.
        variants: Kinds of training data; more than one is an ablation.
        regions: Initial regions of data, rollouts and attempts.
        variations: How the worlds of rollouts or attempts differ, as none, real or hard@0.5:objects.
        perceptions: How rollouts see objects, as exact, rgbd or rgbd,masks=color.
        preset: Hyperparameters.
        num_rollouts: Rollouts of each policy.
        num_attempts: Attempts in each region.
        steps: Training steps.
        device: Where policies are trained and act, such as "cuda".
        num_workers: Cells of the table that are run at a time.
        data_workers: Processes that make the data of a cell, or its attempts.
        budget_hours: Begin nothing after this many hours.
        root: Directory of data, policies and rollouts.
        results: Folder of JSON lines.
        dry_run: Say what would be run, and run nothing.
    """

    table: Table
    tasks: Annotated[tuple[str, ...] | None, default("the table's")] = None
    sizes: Annotated[tuple[int, ...] | None, default("the table's")] = None
    seeds: Annotated[tuple[int, ...] | None, default("the table's")] = None
    policies: Annotated[tuple[Policy, ...] | None, default("the table's")] = None
    variants: Annotated[tuple[Variant, ...] | None, default("the table's")] = None
    regions: Annotated[tuple[str, ...] | None, default("the table's")] = None
    variations: Annotated[tuple[str, ...] | None, default("the table's")] = None
    perceptions: Annotated[tuple[str, ...] | None, default("the table's")] = None
    preset: Preset = "cpu"
    num_rollouts: int = 250
    num_attempts: int = 500
    steps: Annotated[int | None, default("the preset's")] = None
    device: str = "cpu"
    num_workers: int = 1
    data_workers: int = 1
    budget_hours: Annotated[float, default("no end")] = math.inf
    root: Path = Path("outputs/experiments")
    results: Path = Path("results")
    dry_run: bool = False


def run(options: Options) -> None:
    """Run what is missing; the last line on stdout says as JSON what was done and what is missing.

    Raises:
        UnknownNameError: No such task.
        DatasetError: A count or the budget is not positive.
        DemoHLMError: Something went wrong in a cell; the others were run.
    """
    from lerobot_demohlm.experiments.cells import Effort, run_cell
    from lerobot_demohlm.experiments.layout import Layout
    from lerobot_demohlm.experiments.plan import plan
    from lerobot_demohlm.experiments.reproduce import describe, missing, reproduce

    for name in ("num_rollouts", "num_attempts", "num_workers", "data_workers", "budget_hours"):
        if not getattr(options, name) > 0:
            raise DatasetError(f"{name}={getattr(options, name)}", "more than 0", f"correct --{name.replace('_', '-')}")
    layout = Layout(root=options.root, results=options.results)
    cells = plan(
        options.table,
        tasks=options.tasks,
        sizes=options.sizes,
        seeds=options.seeds,
        policies=options.policies,
        variants=options.variants,
        regions=options.regions,
        variations=options.variations,
        perceptions=options.perceptions,
        preset=options.preset,
        steps=options.steps,
    )
    counts = {"num_rollouts": options.num_rollouts, "num_attempts": options.num_attempts}
    if options.dry_run:
        for cell in missing(cells, layout, **counts):
            print(describe(cell))
        return
    effort = Effort(
        **counts,
        data_workers=options.data_workers,
        device=options.device,
        deadline=time.monotonic() + 3600 * options.budget_hours,
    )
    done, failures = reproduce(
        cells,
        layout,
        partial(run_cell, layout=layout, effort=effort),
        num_workers=options.num_workers,
        deadline=effort.deadline,
        **counts,
        command=spelled("reproduce", options, leave_out=_UNSAID),
    )
    left = len(missing(cells, layout, **counts))
    print(json.dumps({"table": options.table, "run": done, "missing": left, "failed": failures}))
    if failures:
        raise DemoHLMError(failures[0], "cells that come to their end", "see the messages above, and run it again")
