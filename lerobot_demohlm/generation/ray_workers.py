"""Blocks of attempts -> made as tasks of a Ray cluster; each comes back as bytes and is stored by this process.

So the workers need no storage in common with the run, and what is on disk is the same as with processes. A worker or a
whole node may die: its blocks are reported as lost, as those of a process are.
"""

import contextlib
import logging
import os
import tempfile
from pathlib import Path
from uuid import uuid4

from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.generation.block import pack_block, unpack_block
from lerobot_demohlm.generation.workers import Done, Make

os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")  # else `uv run` has Ray send this directory to every node

import ray
from ray.exceptions import RayError, RayTaskError


class RayWorkers:
    """Tasks of one CPU each, on the cluster at ``RAY_ADDRESS``, or the one of this machine, or a new one.

    Args:
        make: Makes a block in a task.
        directory: The run's directory, which only this process needs to see.
        num_workers: Largest number of tasks; those that the cluster has no CPU for wait for one.
    """

    def __init__(self, make: Make, directory: Path, num_workers: int) -> None:
        self._directory, self._num_workers = directory, num_workers
        self._connected = not ray.is_initialized()
        if self._connected:
            ray.init(include_dashboard=False, logging_level=logging.WARNING)
        self._task = ray.remote(num_cpus=1, max_retries=0)(_make_block)
        self._make, self._key = ray.put(make), uuid4().hex
        self._working: dict[ray.ObjectRef, range] = {}

    @property
    def free(self) -> int:
        """How many more blocks may be submitted now."""
        return self._num_workers - len(self._working)

    def submit(self, attempts: range) -> None:
        """Have a block made wherever a CPU is free."""
        self._working[self._task.remote(self._key, self._make, attempts)] = attempts

    def wait(self) -> list[Done]:
        """Wait until a block is no longer being made; what the making of it raises is raised here."""
        done = []
        for reference in ray.wait(list(self._working), num_returns=1)[0]:
            attempts = self._working.pop(reference)
            try:
                unpack_block(self._directory, attempts, ray.get(reference))
            except RayTaskError as error:
                if isinstance(error.cause, DemoHLMError):
                    raise error.cause from None
                raise
            except RayError as error:
                done.append(Done(attempts=attempts, death=str(error).strip().partition("\n")[0]))
                continue
            done.append(Done(attempts=attempts))
        return done

    def close(self) -> None:
        """End the tasks, whatever they are at, and leave the cluster."""
        for reference in self._working:
            with contextlib.suppress(RayError):
                ray.cancel(reference, force=True)
        self._working.clear()
        if self._connected:
            ray.shutdown()


# In a worker

_kept: dict[str, Make] = {}
"""The function of the run at hand, with its simulation: Ray keeps a worker's process for the next task."""


def _make_block(key: str, make: Make, attempts: range) -> dict[str, bytes]:
    """Make a block in a scratch directory and return its files."""
    if key not in _kept:
        _kept.clear()
        _kept[key] = make
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch)
        (directory / "blocks").mkdir()
        _kept[key](directory, attempts)
        return pack_block(directory, attempts)
