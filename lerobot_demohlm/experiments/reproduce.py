"""``demohlm reproduce --table main`` -> the lines of that table in ``results/``: what is missing is run, no more.

A cell whose line is there is done, one that was stopped goes on, and a policy's score is always its last checkpoint's.
Cells run side by side, so that a training has a core to itself; what two of them train on, one makes. Each has its own
process: a training leaves its precision behind in the process where it ran, and one that dies takes no other along.
"""

import importlib
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from functools import partial

from gym_demohlm.errors import DemoHLMError
from gym_demohlm.registry import get_task
from lerobot_demohlm.experiments import lines
from lerobot_demohlm.experiments.layout import Layout
from lerobot_demohlm.experiments.lines import GenerationResult, PolicyResult
from lerobot_demohlm.experiments.plan import Cell, RegionCell
from lerobot_demohlm.reproducibility.processes import end_with_parent

Result = PolicyResult | GenerationResult


def missing(
    cells: Sequence[Cell | RegionCell], layout: Layout, num_rollouts: int = 1, num_attempts: int = 1
) -> list[Cell | RegionCell]:
    """Return the cells without a line of results of so many rollouts or attempts, in their order."""
    policies = [found for found in lines.read_policies(layout.policies_file) if found.episodes >= num_rollouts]
    regions = [found for found in lines.read_generation(layout.generation_file) if found.attempts >= num_attempts]
    return [
        cell
        for cell in cells
        if not any(map(cell.is_of, policies) if isinstance(cell, Cell) else map(cell.is_of, regions))
    ]


def reproduce(
    cells: Sequence[Cell | RegionCell],
    layout: Layout,
    run: Callable[[Cell | RegionCell], Result | None],
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
        num_rollouts: Minimum rollouts for an existing result of a policy to be kept.
        num_attempts: Minimum attempts for an existing result of generation to be kept.
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
                if not any(_makes_what_it_needs(other, cell, layout) for other in working.values()):
                    waiting.remove(cell)
                    if not wanted([cell]):
                        continue  # another process has run it since
                    working[pool.submit(_run_apart, run, cell)] = cell
                    print(f"begun: {describe(cell)}, {len(waiting)} after it", file=sys.stderr, flush=True)
            if not working:
                return done, failures
            ended: set[Future[Result | None]] = wait(working, return_when=FIRST_COMPLETED).done
            for future in ended:
                cell = working.pop(future)
                try:
                    result = future.result()
                except Exception as error:  # whatever became of one cell, the others go on
                    kind = "" if isinstance(error, DemoHLMError) else f"{type(error).__name__}: "
                    failures.append(f"{describe(cell)}: {kind}{error}")
                    print(f"failed: {failures[-1]}", file=sys.stderr, flush=True)
                    continue
                if result is not None:
                    file = layout.generation_file if isinstance(cell, RegionCell) else layout.policies_file
                    lines.append(file, command, result)
                    done += 1


def _run_apart(run: Callable[[Cell | RegionCell], Result | None], cell: Cell | RegionCell) -> Result | None:
    """Run a cell in a new process."""
    context, module = multiprocessing.get_context("spawn"), get_task(cell.task).module
    with ProcessPoolExecutor(1, mp_context=context, initializer=_start_worker, initargs=(module,)) as process:
        return process.submit(run, cell).result()


def _start_worker(module: str) -> None:
    """Import what registers the task: it may be from outside the package."""
    end_with_parent()
    importlib.import_module(module)


def _makes_what_it_needs(other: Cell | RegionCell, cell: Cell | RegionCell, layout: Layout) -> bool:
    """Tell whether another cell may be making the data or the policy that a cell needs."""
    if not (isinstance(other, Cell) and isinstance(cell, Cell)):
        return False
    if layout.training(other) == layout.training(cell):
        return not layout.times(cell).exists()
    if (other.task, other.region, other.variant, other.sees) != (cell.task, cell.region, cell.variant, cell.sees):
        return False
    return not layout.data(cell).exists()


def describe(cell: Cell | RegionCell) -> str:
    """Return what a cell is called in messages."""
    if isinstance(cell, Cell):
        return cell.name
    return f"{cell.task} in {cell.region}" + (f" under {cell.variation}" if cell.variation != "none" else "")
