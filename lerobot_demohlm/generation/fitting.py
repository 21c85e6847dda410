"""A demonstration with a box of one size -> the same with the box as it is here: hands at its sides move with them."""

from dataclasses import replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.task import Lengths, Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration

PRESSED_M = 0.05  # a palm that presses on a side has its target up to this far inside the box


def fitted(demonstration: Demonstration, task: Task) -> Demonstration:
    """Return a demonstration whose hands are where they would be had its boxes the sizes that they have here.

    A hand at a side of the box, or beyond it, moves as far as the side does. One over or under the box keeps its place
    between the sides: it moves the further, the further it is from the middle. The rotation of hands, the robot and the
    objects stay as they are.

    Args:
        demonstration: The source.
        task: Whose objects say what is not as demonstrated, see ``ObjectSpec.resized``.

    Returns:
        The demonstration itself where all is as demonstrated.
    """
    for column, entry in enumerate(task.objects):
        if entry.resized is not None:
            T_world_box = demonstration.T_world_objects[:, None, column]  # (T, 1, 4, 4)
            hands, targets = (
                np.concatenate([_moved(numbers[..., :3], T_world_box, *entry.resized), numbers[..., 3:]], axis=-1)
                for numbers in (demonstration.hand_poses, demonstration.hand_targets)
            )
            demonstration = replace(demonstration, hand_poses=hands, hand_targets=targets)
    return demonstration


def _moved(p_world: np.ndarray, T_world_box: np.ndarray, then: Lengths, now: Lengths) -> np.ndarray:
    """Return points (..., 3) [m] near a box (..., 4, 4) that has other lengths now."""
    p_box = poses.transform(poses.invert(T_world_box), p_world)
    share = np.clip(p_box / (0.5 * np.array(then) - PRESSED_M), -1.0, 1.0)
    offset = 0.5 * (np.array(now) - np.array(then)) * share
    return p_world + (T_world_box[..., :3, :3] * offset[..., None, :]).sum(axis=-1)
