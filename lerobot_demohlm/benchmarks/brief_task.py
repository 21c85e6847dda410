"""LiftBox -> a task whose attempts take a second of simulated time, for faults and clusters rather than for robots.

Its demonstration is LiftBox's, under the other name. An attempt succeeds where the box is turned to the left, so some
do and some do not.
"""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np

from gym_demohlm.registry import get_task, register_task
from gym_demohlm.simulation.worlds import Worlds
from lerobot_demohlm.demonstrations import demonstration

LIFT_BOX = get_task("LiftBox")


def build(spec: mujoco.MjSpec) -> None:
    """Add LiftBox's things to the robot's world."""
    LIFT_BOX.build(spec)


def turned_left(sim: Worlds) -> np.ndarray:
    """Return in which worlds (N,) the box is turned to the left, or by less than 0.2 rad to the right."""
    return sim.pose("box")[:, 1, 0] > -np.sin(0.2)


TASK = register_task(
    dataclasses.replace(LIFT_BOX, name="LiftBoxBriefly", build=build, success=turned_left, episode_length_s=1.2)
)


def save_demonstration(root: Path) -> None:
    """Write the task's demonstration."""
    lift_box = demonstration.load(task=LIFT_BOX)
    metadata = lift_box.metadata | {"task": TASK.name}
    dataclasses.replace(lift_box, task=TASK.name, metadata=metadata).save(root, TASK)
