"""Blocks of attempts -> made by processes of this machine; a worker that dies is reported, and gets a successor.

What a worker does is a picklable function ``make(directory, attempts)`` that writes the block into the directory of a
run; it keeps in the worker what it needs again, such as the simulation.
"""

import contextlib
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from gym_demohlm.errors import DemoHLMError
from lerobot_demohlm.reproducibility.processes import end_with_parent

Make = Callable[[Path, range], None]

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")  # LP: Mesa's drawing


@dataclass(frozen=True, kw_only=True)
class Done:
    """A block that is no longer being made.

    Attributes:
        attempts: Of the block.
        death: What ended its worker before the block was written; None where it is on disk.
    """

    attempts: range
    death: str | None = None


class Workers(Protocol):
    """Makes blocks, several at a time."""

    @property
    def free(self) -> int:
        """How many more blocks may be submitted now."""
        ...

    def submit(self, attempts: range) -> None:
        """Have a block made."""
        ...

    def wait(self) -> list[Done]:
        """Wait until one block or more are no longer being made; what the making of one raises is raised here."""
        ...

    def close(self) -> None:
        """End the workers, whatever they are at."""
        ...


@dataclass(kw_only=True)
class _Worker:
    process: BaseProcess
    pipe: connection.Connection
    attempts: range | None = None


class ProcessWorkers:
    """Worker processes of one thread each; they end with this process, however it ends, and leave Ctrl-C to it.

    Args:
        make: Makes a block in a worker.
        directory: The run's directory.
        num_workers: Largest number of processes; one is started when there is a block for it.
    """

    def __init__(self, make: Make, directory: Path, num_workers: int) -> None:
        self._make, self._directory, self._num_workers = make, directory, num_workers
        self._workers: list[_Worker] = []

    @property
    def free(self) -> int:
        """How many more blocks may be submitted now."""
        return self._num_workers - sum(worker.attempts is not None for worker in self._workers)

    def submit(self, attempts: range) -> None:
        """Have a block made by an idle worker or a new one."""
        worker = next((worker for worker in self._workers if worker.attempts is None), None) or self._start()
        worker.attempts = attempts
        with contextlib.suppress(OSError):  # a dead one is noticed when it is waited for
            worker.pipe.send(attempts)

    def wait(self) -> list[Done]:
        """Wait until one block or more are no longer being made; what the making of one raises is raised here."""
        busy = {worker.pipe: worker for worker in self._workers if worker.attempts is not None}
        done = []
        for pipe in connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            attempts, worker.attempts = worker.attempts, None
            assert attempts is not None  # it is busy
            try:
                error = worker.pipe.recv()
            except (EOFError, OSError):
                done.append(Done(attempts=attempts, death=self._bury(worker)))
                continue
            if error is not None:
                raise error
            done.append(Done(attempts=attempts))
        return done

    def close(self) -> None:
        """End the workers, whatever they are at: a block appears whole or not at all."""
        for worker in list(self._workers):
            worker.process.kill()
            self._bury(worker)

    def _start(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        resource_tracker.ensure_running()  # starting it unblocks signals
        with _one_thread(), _shielded():
            process = context.Process(target=_work, args=(there,), daemon=True)
            process.start()
        there.close()
        worker = _Worker(process=process, pipe=here)
        self._workers.append(worker)
        with contextlib.suppress(OSError):
            here.send((self._make, self._directory))
        return worker

    def _bury(self, worker: _Worker) -> str:
        """Return what a worker died of."""
        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join(timeout=1.0)
        worker.process.kill()
        worker.process.join()
        code = worker.process.exitcode or 0
        if code >= 0:
            return f"ended with exit code {code}"
        often = ", often for want of memory" if code == -signal.SIGKILL else ""
        return f"killed by {signal.Signals(-code).name}{often}"


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Have processes that are started here use one thread in NumPy and to draw: they read it when they begin to."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _shielded() -> Iterator[None]:
    """Have processes that are started here never see Ctrl-C; here it comes a moment later."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# In a worker


def _work(pipe: connection.Connection) -> None:
    """Make the blocks that come through the pipe and answer with None or what went wrong, until the pipe closes."""
    end_with_parent()
    with contextlib.suppress(EOFError, BrokenPipeError):
        make, directory = pipe.recv()
        while True:
            pipe.send(_made(make, directory, pipe.recv()))


def _made(make: Make, directory: Path, attempts: range) -> Exception | None:
    try:
        make(directory, attempts)
    except DemoHLMError as error:
        return error
    except Exception:
        return RuntimeError(f"attempts {attempts.start} to {attempts.stop - 1}:\n{traceback.format_exc()}")
    return None
