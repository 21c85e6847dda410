"""The robot's model -> how far its shoulders may roll inwards before the trunk stops the upper arms.

Inverse kinematics that knows nothing of the trunk asks a right arm that reaches to the left for a roll which the trunk
does not let it have, and the palm ends centimetres off its target, turned.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from gym_demohlm.control import command
from gym_demohlm.robot import g1

_INWARD = {"left": -1.0, "right": 1.0}  # the sign of a roll towards the trunk
_PITCHES = np.linspace(-3.0, 2.6, 57)  # rad, every 0.1 over the joint's range
_ROLL_STEP = 0.01  # rad
_FREE = -60  # steps of roll at which an arm is clear of the trunk in any pitch


class ShoulderRoom:
    """The largest inward rolls of both shoulders, by their pitch.

    A model whose trunk does not stop upper arms, as in the first physics, has no such limit.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Find the limits.

        Args:
            model: Any model that contains the robot.
        """
        self._limits = [_limits(model, side) for side in g1.SIDES]  # (57,) each [rad]
        self._pitches = [command.NAMES.index(f"{side}_shoulder_pitch.pos") for side in g1.SIDES]
        self._rolls = [command.NAMES.index(f"{side}_shoulder_roll.pos") for side in g1.SIDES]

    def narrow(self, previous: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of a command without the rolls that the trunk stops at the previous command's pitch.

        Args:
            previous: (23,) the command before.
            lower: (23,) and the next, the command's own bounds.
            upper: (23,).
        """
        lower, upper = lower.copy(), upper.copy()
        for side, pitch, roll, limits in zip(g1.SIDES, self._pitches, self._rolls, self._limits, strict=True):
            limit = float(np.interp(previous[pitch], _PITCHES, limits))
            if _INWARD[side] > 0.0:
                upper[roll] = min(upper[roll], limit)
            else:
                lower[roll] = max(lower[roll], -limit)
        return lower, upper


def _limits(model: mujoco.MjModel, side: str) -> np.ndarray:
    """Return the largest inward roll [rad] of a shoulder for each pitch; infinity where nothing stops it."""
    arm, trunk = _geoms(model, f"{side}_shoulder_yaw_link"), _geoms(model, "torso_link")
    pairs = [(a, b) for a in arm for b in trunk if _meet(model, a, b)]
    limits = np.full(len(_PITCHES), math.inf)
    if not pairs:
        return limits
    data = mujoco.MjData(model)
    pitch, roll = (int(model.joint(f"{side}_shoulder_{axis}_joint").qposadr[0]) for axis in ("pitch", "roll"))
    steps = math.floor(command.UPPER[command.NAMES.index("right_shoulder_roll.pos")] / _ROLL_STEP)
    for index, angle in enumerate(_PITCHES):
        data.qpos[pitch] = angle
        free, blocked = _FREE, steps + 1
        while blocked - free > 1:  # the inner of the two is always free, the outer one never, or out of range
            middle = (free + blocked) // 2
            data.qpos[roll] = _INWARD[side] * middle * _ROLL_STEP
            if _apart(model, data, pairs):
                free = middle
            else:
                blocked = middle
        if blocked <= steps:
            limits[index] = free * _ROLL_STEP
    return limits


def _geoms(model: mujoco.MjModel, body: str) -> list[int]:
    return [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == model.body(body).id]


def _meet(model: mujoco.MjModel, first: int, second: int) -> bool:
    kinds, others = model.geom_contype, model.geom_conaffinity
    return bool(kinds[first] & others[second] or kinds[second] & others[first])


def _apart(model: mujoco.MjModel, data: mujoco.MjData, pairs: Sequence[tuple[int, int]]) -> bool:
    mujoco.mj_kinematics(model, data)
    return all(mujoco.mj_geomDistance(model, data, *pair, 1.0, None) >= 0.0 for pair in pairs)
