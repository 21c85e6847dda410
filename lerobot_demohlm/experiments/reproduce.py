"""``demohlm reproduce --table main`` -> the lines of that table in ``results/``: what is missing is run, no more.

A cell whose line is there is done, one that was stopped goes on, and a policy's score is always its last checkpoint's.
Cells run side by side, so that a training has a core to itself; what two of them train on, one makes. Each has its own
process: a training leaves its precision behind in the process where it ran, and one that dies takes no other along.
"""

import argparse
import importlib
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError, DemoHLMError
from gym_demohlm.registry import get_task
from lerobot_demohlm.experiments import lines
from lerobot_demohlm.experiments.plan import DEFAULT_VARIANT, TABLES, VARIANTS, Cell, Layout, RegionCell, plan
from lerobot_demohlm.policies.presets import NAMES, POLICIES
from lerobot_demohlm.reproducibility.processes import end_with_parent

_CHOICES = ("tasks", "sizes", "seeds", "policies", "variants")
Line = dict[str, Any]


def missing(
    cells: Sequence[Cell | RegionCell], layout: Layout, num_rollouts: int = 1, num_attempts: int = 1
) -> list[Cell | RegionCell]:
    """Return the cells without a line of results of so many rollouts or attempts, in their order."""
    policies = [line for line in lines.read(layout.policies_file) if line.get("episodes", 0) >= num_rollouts]
    regions = [line for line in lines.read(layout.generation_file) if line.get("attempts", 0) >= num_attempts]
    return [
        cell
        for cell in cells
        if not any(cell.is_of(line) for line in (policies if isinstance(cell, Cell) else regions))
    ]


def reproduce(
    cells: Sequence[Cell | RegionCell],
    layout: Layout,
    run: Callable[[Cell | RegionCell], Line | None],
    *,
    num_workers: int = 1,
    deadline: float = math.inf,
    num_rollouts: int = 1,
    num_attempts: int = 1,
    command: str = "demohlm reproduce",
) -> tuple[int, list[str]]:
    """Run the cells that are missing and append their lines.

    Args:
        cells: The most wanted first.
        layout: Where everything is.
        run: What runs a cell, None where its time was up; importable, as it is called in other processes.
        num_workers: Cells at a time; one waits while another makes the data that both need.
        deadline: Begin no cell after this time (``time.monotonic``) [s].
        num_rollouts: A line of fewer rollouts is not enough,
        num_attempts: nor one of fewer attempts.
        command: What the lines say that they come from.

    Returns:
        How many cells are done now, and what went wrong in others, a line each.
    """
    wanted = partial(missing, layout=layout, num_rollouts=num_rollouts, num_attempts=num_attempts)
    waiting, working, failures, done = wanted(cells), {}, [], 0
    with ThreadPoolExecutor(num_workers) as pool:
        while True:
            for cell in list(waiting):
                if len(working) >= num_workers or time.monotonic() >= deadline:
                    break
                if not any(_makes_data_of(other, cell, layout) for other in working.values()):
                    waiting.remove(cell)
                    if not wanted([cell]):
                        continue  # another process has run it since
                    working[pool.submit(_run_apart, run, cell)] = cell
                    print(f"begun: {_describe(cell)}, {len(waiting)} after it", file=sys.stderr, flush=True)
            if not working:
                return done, failures
            ended: set[Future[Line | None]] = wait(working, return_when=FIRST_COMPLETED).done
            for future in ended:
                cell = working.pop(future)
                try:
                    line = future.result()
                except Exception as error:  # whatever became of one cell, the others go on
                    kind = "" if isinstance(error, DemoHLMError) else f"{type(error).__name__}: "
                    failures.append(f"{_describe(cell)}: {kind}{error}")
                    print(f"failed: {failures[-1]}", file=sys.stderr, flush=True)
                    continue
                if line is not None:
                    file = layout.generation_file if isinstance(cell, RegionCell) else layout.policies_file
                    lines.append(file, command, line)
                    done += 1


def _run_apart(run: Callable[[Cell | RegionCell], Line | None], cell: Cell | RegionCell) -> Line | None:
    """Run a cell in a new process."""
    context, module = multiprocessing.get_context("spawn"), get_task(cell.task).module
    with ProcessPoolExecutor(1, mp_context=context, initializer=_start_worker, initargs=(module,)) as process:
        return process.submit(run, cell).result()


def _start_worker(module: str) -> None:
    """Import what registers the task: it may be from outside the package."""
    end_with_parent()
    importlib.import_module(module)


def _makes_data_of(other: Cell | RegionCell, cell: Cell | RegionCell, layout: Layout) -> bool:
    """Tell whether another cell may be making the data that a cell needs."""
    if not (isinstance(other, Cell) and isinstance(cell, Cell)):
        return False
    if (other.task, other.region, other.variant) != (cell.task, cell.region, cell.variant):
        return False
    return not layout.dataset(cell.task, cell.region, cell.num_train_episodes, cell.variant).exists()


def _describe(cell: Cell | RegionCell) -> str:
    return cell.name if isinstance(cell, Cell) else f"{cell.task} in {cell.region}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm reproduce``."""
    parser.add_argument("--table", choices=TABLES, required=True, help="which of the paper's tables")
    parser.add_argument("--tasks", nargs="+", help="names of tasks (default: the table's)")
    parser.add_argument("--sizes", nargs="+", type=int, help="numbers of training episodes, most wanted first")
    parser.add_argument("--seeds", nargs="+", type=int, help="of the trainings (default: the table's)")
    parser.add_argument("--policies", nargs="+", choices=POLICIES, help="(default: the table's)")
    parser.add_argument(
        "--variants",
        nargs="+",
        choices=tuple(VARIANTS),
        help=f"of the training data; more than one is an ablation (default: {DEFAULT_VARIANT})",
    )
    parser.add_argument("--preset", default="cpu", choices=NAMES, help="hyperparameters (default: %(default)s)")
    parser.add_argument("--num-rollouts", type=int, default=250, help="of each policy (default: %(default)s)")
    parser.add_argument("--num-attempts", type=int, default=500, help="in each region (default: %(default)s)")
    parser.add_argument("--steps", type=int, help="training steps (default: the preset's)")
    parser.add_argument("--device", default="cpu", help="where policies are trained and act (default: %(default)s)")
    parser.add_argument("--num-workers", type=int, default=1, help="cells at a time (default: %(default)s)")
    parser.add_argument(
        "--budget-hours", type=float, default=math.inf, help="begin nothing after so long (default: no end)"
    )
    parser.add_argument("--root", type=Path, default=Path("outputs/experiments"), help="of data, policies and rollouts")
    parser.add_argument("--results", type=Path, default=Path("results"), help="folder of JSON lines")
    parser.add_argument("--dry-run", action="store_true", help="say what would be run, and run nothing")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm reproduce``; the last line on stdout says as JSON what was done and what is missing.

    Raises:
        UnknownNameError: No such task.
        DatasetError: A count or the budget is not positive.
        DemoHLMError: Something went wrong in a cell; the others were run.
    """
    from lerobot_demohlm.experiments.cells import Effort, run_cell

    for name in ("num_rollouts", "num_attempts", "num_workers", "budget_hours"):
        if not getattr(arguments, name) > 0:
            raise DatasetError(
                f"{name}={getattr(arguments, name)}", "more than 0", f"correct --{name.replace('_', '-')}"
            )
    layout = Layout(root=arguments.root, results=arguments.results)
    chosen = {name: getattr(arguments, name) for name in (*_CHOICES, "preset", "steps")}
    counts = {name: getattr(arguments, name) for name in ("num_rollouts", "num_attempts")}
    cells = plan(arguments.table, **chosen)
    if arguments.dry_run:
        for cell in missing(cells, layout, **counts):
            print(_describe(cell))
        return
    effort = Effort(
        **counts,
        device=arguments.device,
        deadline=time.monotonic() + 3600 * arguments.budget_hours,
    )
    done, failures = reproduce(
        cells,
        layout,
        partial(run_cell, layout=layout, effort=effort),
        num_workers=arguments.num_workers,
        deadline=effort.deadline,
        **counts,
        command=_command(arguments),
    )
    left = len(missing(cells, layout, **counts))
    print(json.dumps({"table": arguments.table, "run": done, "missing": left, "failed": failures}))
    if failures:
        raise DemoHLMError(failures[0], "cells that come to their end", "see the messages above, and run it again")


def _command(arguments: argparse.Namespace) -> str:
    """Return the call that makes the lines, without where things are and how many cells run at a time."""
    words = ["demohlm reproduce --table", arguments.table]
    for name in _CHOICES:
        values = getattr(arguments, name)
        words += [f"--{name}", *map(str, values)] if values else []
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for name in ("preset", "num_rollouts", "num_attempts", "steps", "device"):
        value = getattr(arguments, name)
        words += [f"--{name.replace('_', '-')}", str(value)] if value != parser.get_default(name) else []
    return " ".join(words)
