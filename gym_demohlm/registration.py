"""A task -> its Gymnasium environment ``DemoHLM/<name>-v0``, single and vectorised."""

from typing import TYPE_CHECKING

import gymnasium as gym

if TYPE_CHECKING:
    from gym_demohlm.task import Task

NAMESPACE = "DemoHLM"


def environment_id(task_name: str) -> str:
    """Return the Gymnasium id of a task, "LiftBox" -> "DemoHLM/LiftBox-v0"."""
    return f"{NAMESPACE}/{task_name}-v0"


def register_environment(task: "Task") -> None:
    """Register a task's environment with Gymnasium, once; the environment itself counts the time limit."""
    identifier = environment_id(task.name)
    if identifier not in gym.registry:
        gym.register(
            id=identifier,
            entry_point="gym_demohlm.env:DemoHLMEnv",
            vector_entry_point="gym_demohlm.vector_env:DemoHLMVectorEnv",
            kwargs={"task": task.name},
        )
