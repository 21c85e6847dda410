"""A demonstration -> when nothing of the robot moves.

A policy that sees the present only cannot tell how long it has waited. Where episodes of its data rest for longer than
the actions that it carries out at once, it may rest for good (docs/policies.md,
"Pauses in the demonstration").
"""

import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.timing import FPS
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import stretches

LEAST_TICKS = round(1.0 * FPS)  # a shorter rest is none
STILL_M_S = 0.02  # of a palm
STANDING_M_S = 0.05  # of the pelvis, which sways
_SAME = 0.05  # of a gripper's command, from tick to tick


def pauses(demonstration: Demonstration, least_ticks: int = LEAST_TICKS) -> list[tuple[int, int]]:
    """Return the stretches [start, stop) of ticks in which palms, pelvis and grippers rest, in the order of time.

    Args:
        demonstration: The recording.
        least_ticks: Shorter stretches are left out.
    """
    palms = norm(np.diff(demonstration.T_world_hands[:, :, :3, 3], axis=0)).max(axis=1) * FPS
    pelvis = norm(np.diff(demonstration.T_world_pelvis[:, :2, 3], axis=0)) * FPS
    grippers = np.abs(np.diff(demonstration.action[:, command.GRIPPERS], axis=0)).max(axis=1)
    rests = (palms < STILL_M_S) & (pelvis < STANDING_M_S) & (grippers < _SAME)
    return [(start, stop) for start, stop in stretches(rests) if stop - start >= least_ticks]
