"""Simulation -> what its results depend on: hashes of the controller and of the compiled model."""

import hashlib
import re

import mujoco
import numpy as np

from gym_demohlm.control.whole_body import Weights
from gym_demohlm.task import Task


def controller_hash() -> str:
    """Return the SHA-256 of the shipped controller's weights."""
    return Weights().hash


def model_hash(model: mujoco.MjModel) -> str:
    """Return the SHA-256 of a compiled model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def file_name(task: Task) -> str:
    """Return a task's name as files have it: ``LiftBox`` -> ``lift_box``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", task.name).lower()
