"""The paper's replay as it is written, beside ours: once a part of the motion has begun, nothing is looked at any more.

The paper walks to the object, transforms the demonstrated hand poses by the object's pose, solves inverse kinematics
and executes what comes of it. What this generator adds, and ``open_replay`` takes away:

- walks that are made again where the robot stands off its goal;
- hands that are steered by what they measurably miss, and inverse kinematics from where the base has gone;
- hands that wait for the torso;
- walks with something in the hands that follow the demonstrated path;
- grips that settle and are verified, and palms that press as hard as it takes;
- bases that are led back to where they stood, and second tries;
- attempts that end as soon as the hands trail behind.

What stays is the robot's own posture, which inverse kinematics starts from, and the object's pose when a part begins.
Walks with a load to a goal (``carrying``), which the paper does not have, stay as they are.
"""

import math
from dataclasses import replace

from gym_demohlm.task import Task
from lerobot_demohlm.generation.stages import AdaptationSettings, GripSettings, Settings

_ANYWHERE = math.inf  # m, rad: a limit that nothing exceeds


def open_replay(settings: Settings) -> Settings:
    """Return settings with all feedback taken away; the variation stays."""
    return replace(
        settings,
        locomotion=replace(settings.locomotion, max_walks=1, accept_m=_ANYWHERE, accept_rad=_ANYWHERE),
        adaptation=AdaptationSettings(
            squeeze=0.0,
            leave_m=_ANYWHERE,
            holding_leave_m=_ANYWHERE,
            highest_m=_ANYWHERE,
            grip_n=0.0,
            retries=0,
            max_walks=1,
            accept_m=_ANYWHERE,
        ),
        grip=GripSettings(settle_ticks=0, grip_n=0.0, grip_ticks=1),
        playback=replace(
            settings.playback,
            steering_gain=0.0,
            path_gain=(0.0, 0.0, 0.0),
            arrive_ticks=0,
            watches_base=False,
            torso_error_m=_ANYWHERE,
            reach_error_m=_ANYWHERE,
            hold_error_m=_ANYWHERE,
            displaced_m=_ANYWHERE,
        ),
    )


def without_symmetry(task: Task) -> Task:
    """Return a task whose objects are taken from the demonstrated side only, however much they look the same."""
    return replace(task, objects=tuple(replace(entry, symmetry=(0.0,)) for entry in task.objects))
