"""Tasks by name, from the files in ``tasks/`` and from ``register_task``, each with its Gymnasium environment."""

import functools
import importlib
import pkgutil
from pathlib import Path

import gymnasium as gym

from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.task import Task

NAMESPACE = "DemoHLM"


def environment_id(task_name: str) -> str:
    """Return the Gymnasium id of a task, "LiftBox" -> "DemoHLM/LiftBox-v0"."""
    return f"{NAMESPACE}/{task_name}-v0"


def register_environment(task: Task) -> None:
    """Register a task's environment with Gymnasium, once; the environment itself counts the time limit."""
    identifier = environment_id(task.name)
    if identifier not in gym.registry:
        gym.register(
            id=identifier,
            entry_point="gym_demohlm.envs.env:DemoHLMEnv",
            vector_entry_point="gym_demohlm.envs.vector_env:DemoHLMVectorEnv",
            kwargs={"task": task.name},
        )


_registered: dict[str, Task] = {}


def register_task(task: Task) -> Task:
    """Register a task under its name, and its environment ``DemoHLM/<name>-v0``; return the task.

    Raises:
        SceneError: Another task has that name.
    """
    if _registered.setdefault(task.name, task) is not task:
        raise SceneError(f"a second task {task.name!r}", "one task a name", "rename one of the two")
    register_environment(task)
    return task


@functools.cache
def _load_task_files() -> None:
    folder = Path(__file__).parent / "tasks"  # found by name: task files import what is below them, this included
    for module in sorted(entry.name for entry in pkgutil.iter_modules([str(folder)])):
        register_task(importlib.import_module(f"gym_demohlm.tasks.{module}").TASK)


def all_tasks() -> dict[str, Task]:
    """Return all tasks by name: those of the package and those registered from outside."""
    _load_task_files()
    return dict(sorted(_registered.items()))


def get_task(name: str) -> Task:
    """Return a task by its name, "LiftBox" or "LiftBox-v0".

    As in Gymnasium, "my_module:MyTask" first imports the module, which registers the task.

    Raises:
        UnknownNameError: There is no such task; the message names the closest one.
        SceneError: There is no such module.
    """
    if not isinstance(name, str):
        raise UnknownNameError("task", name, all_tasks())
    module, _, bare = name.rpartition(":")
    if module:
        _import(module)
    found = all_tasks()
    bare = bare.removeprefix("DemoHLM/").removesuffix("-v0")
    if bare not in found:
        raise UnknownNameError("task", bare, found)
    return found[bare]


def _import(module: str) -> None:
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise SceneError(
            f"a task in the module {module!r}, which is not found", "a module on Python's path", "set PYTHONPATH"
        ) from None
