"""Simulation -> what its results depend on: hashes of controller and compiled model, versions, kind of processor."""

import functools
import hashlib
import importlib.metadata
import inspect
import platform
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import mujoco
import numpy as np

import gym_demohlm
from gym_demohlm.control import controllers
from gym_demohlm.errors import DatasetError
from gym_demohlm.task import Task

LIBRARIES = ("mujoco", "numpy", "numba", "placo", "eigenpy")
"""Packages whose version decides bits. The C library and the kind of processor do so too."""
_GENERATOR = ("datasets", "demonstrations", "generation", "reproducibility")  # packages of this one
_CHECKER = ("adoption", "checks", "teleop")  # packages of this one, by which a controller is adopted
_FMA_FLAGS = ("fma", "avx2", "avx512f", "asimd", "sve")  # of /proc/cpuinfo; each implies fused multiply-add


def controller_hash(controller: str = controllers.DEFAULT) -> str:
    """Return the SHA-256 of a controller's weights, see ``control.controllers``."""
    return controllers.load(controller).hash


def model_hash(model: mujoco.MjModel) -> str:
    """Return the SHA-256 of a compiled model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


@functools.cache
def code_hash() -> str:
    """Return the SHA-256 of the code that simulates: ``gym_demohlm`` but for what trains the controller."""
    root, digest = Path(gym_demohlm.__file__).parent, hashlib.sha256()
    _add(digest, root, (path for path in root.rglob("*.py") if "wbc" not in path.relative_to(root).parts[:1]))
    return digest.hexdigest()


def task_hash(task: Task) -> str:
    """Return the SHA-256 of the files that hold a task's functions, empty where they are those of ``gym_demohlm``.

    A process reads each file once: it goes on to judge by that one when the file is edited.

    Raises:
        DatasetError: There is no such file, as of a task that was typed in.
    """
    memory = () if task.memory is None else (task.memory.update, task.memory.draw)
    wide = () if task.wide_form is None else (task.wide_form.build,)
    functions = (task.build, task.success, *task.failures.values(), *memory, *wide)
    modules = {function.__module__ for function in functions}
    files = {_source_hash(module) for module in modules if module.partition(".")[0] != gym_demohlm.__name__}
    return hashlib.sha256(" ".join(sorted(files)).encode()).hexdigest() if files else ""


@functools.cache
def _source_hash(module: str) -> str:
    """Return the SHA-256 of the file of a module that was imported."""
    try:
        text = inspect.getsource(sys.modules[module])
    except (OSError, TypeError, KeyError) as error:
        raise DatasetError(
            f"a task with a function in {module!r}, which has no file",
            "functions in files, so that a run is resumed with the same ones",
            "write the task into a file, and import it",
        ) from error
    return hashlib.sha256(text.encode()).hexdigest()


def simulation_hash(task: Task) -> str:
    """Return the SHA-256 of the code that simulates and judges a task: ``code_hash``, unless it has other files too.

    Raises:
        DatasetError: See ``task_hash``.
    """
    outside = task_hash(task)
    return hashlib.sha256(f"{code_hash()} {outside}".encode()).hexdigest() if outside else code_hash()


@functools.cache
def generator_hash() -> str:
    """Return the SHA-256 of the code that decides what a generation run writes beside what simulates."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    _add(digest, root, (path for package in _GENERATOR for path in (root / package).rglob("*.py")))
    return digest.hexdigest()


@functools.cache
def checker_hash() -> str:
    """Return the SHA-256 of the code that checks a new controller, beside what simulates and generates."""
    ours, theirs, digest = Path(__file__).parents[1], Path(gym_demohlm.__file__).parent, hashlib.sha256()
    _add(digest, ours, (path for package in _CHECKER for path in (ours / package).rglob("*.py")))
    _add(digest, theirs, (theirs / "wbc" / "evaluation").rglob("*.py"))
    return digest.hexdigest()


def _add(digest: "hashlib._Hash", root: Path, paths: Iterable[Path]) -> None:
    """Add files, with their names in a folder, to a digest."""
    for path in sorted(paths):
        name = path.relative_to(root).as_posix()
        digest.update(f"{name} {path.stat().st_size} ".encode() + path.read_bytes())


def processor() -> dict[str, str]:
    """Return the first entry of ``/proc/cpuinfo`` by its keys; empty on a system without that file."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return {}
    entries = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
    return {key.strip(): value.strip() for key, _, value in entries}


def processor_flags() -> frozenset[str]:
    """Return the features of the processor by the names that Linux gives them, such as ``avx2``."""
    found = processor()
    return frozenset(found.get("flags", found.get("Features", "")).split())


@functools.cache
def cpu_family() -> str:
    """Return the kind of processor, which decides bits: its architecture, and whether it has fused multiply-add (FMA).

    The maker and wider vector units decide nothing: ``gym_demohlm.arithmetic`` does not depend on them.
    """
    return kind_of_processor(" ".join([platform.machine(), *processor_flags()]))


def kind_of_processor(text: str) -> str:
    """Return the kind of processor that a text describes: ``x86_64 with FMA``.

    Args:
        text: An architecture and what else is known: features, or the whole of an older record such as
            ``x86_64 AuthenticAMD avx512f``.
    """
    machine, *rest = text.split() or ["unknown"]
    if "without" in rest:
        return f"{machine} without FMA"
    return f"{machine} {'with' if {flag.lower() for flag in rest} & set(_FMA_FLAGS) else 'without'} FMA"


def bit_versions() -> dict[str, str]:
    """Return what decides bits besides this package's code: versions of libraries and of the C library, processor."""
    found = {name: importlib.metadata.version(name) for name in LIBRARIES}
    return found | {"libc": " ".join(platform.libc_ver()).strip() or "unknown", "cpu": cpu_family()}


def bit_differences(then: Mapping[str, str], now: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """Return what differs in what decides bits, a line each; empty where bits must agree.

    Args:
        then: Versions that were recorded. What was not recorded may differ, so it is a line too.
        now: Versions to compare with; those of this machine by default.
    """
    lines = []
    for name, value in (bit_versions() if now is None else now).items():
        known = then.get(name)
        if known is None:
            lines.append(f"{name} not recorded, {value} now")
        elif (kind_of_processor(known) if name == "cpu" else known) != value:
            lines.append(f"{name} {known} then, {value} now")
    return tuple(lines)
