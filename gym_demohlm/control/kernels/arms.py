"""``control.arm_load``: what the arms of one world weigh, and what they carry."""

import math

import numpy as np

from gym_demohlm.control import arm_load
from gym_demohlm.control.kernels.compiler import inlined
from gym_demohlm.control.kernels.postures import clip, copy

_NUM = arm_load.NUM_JOINTS
_SIZE, _COLUMNS = arm_load.TABLE_SHAPE
_MIRROR, _SIDEWAYS = arm_load.MIRROR, arm_load.SIDEWAYS
_STIFFNESS, _DAMPING = arm_load.STIFFNESS, arm_load.DAMPING
_GRAVITY, _LITTLE, _LARGEST = arm_load.GRAVITY, arm_load.LITTLE, arm_load.LARGEST
_SWINGING_SQUARED, _WEIGHING_S = arm_load.SWINGING**2, arm_load.WEIGHING_S


@inlined
def _product(table, per_unit, most, factors, out):
    """``ArmLoad._product(_products(factors))``, (4, 3) -> (6,): exact, so in any order."""
    for column in range(_COLUMNS):
        out[column] = 0.0
    index = 0
    for a in range(3):
        first = factors[0, a]
        for b in range(3):
            second = first * factors[1, b]
            for c in range(3):
                third = second * factors[2, c]
                for d in range(3):
                    step = np.rint(min(max(third * factors[3, d] * per_unit, -most), most))
                    for column in range(_COLUMNS):
                        out[column] += step * table[index, column]
                    index += 1


@inlined
def moment(load, arms, carried):
    """``ArmLoad.__call__``: the moment along the axes of the torso."""
    table, per_unit, most, home = load
    factors, found = np.empty((_NUM, 3)), np.empty(_COLUMNS)
    x, y, z = 0.0, 0.0, 0.0
    for side in range(2):
        for joint in range(_NUM):
            angle = arms[_NUM * side + joint] * _MIRROR[side, joint]
            factors[joint, 0], factors[joint, 1], factors[joint, 2] = 1.0, math.cos(angle), math.sin(angle)
        _product(table, per_unit, most, factors, found)
        x += (found[0] + carried[side] * found[3]) * _SIDEWAYS[side, 0]
        y += (found[1] + carried[side] * found[4]) * _SIDEWAYS[side, 1]
        z += (found[2] + carried[side] * found[5]) * _SIDEWAYS[side, 2]
    return x - home[0], y - home[1], z - home[2]


@inlined
def arms_moment(load, command, arms, carried):
    """``Reference.arms_moment``: ahead and to the left."""
    roll, pitch = command[4], command[5]
    x, y, z = moment(load, arms, carried)
    across = math.sin(roll) * y + math.cos(roll) * z
    return math.cos(pitch) * x + math.sin(pitch) * across, math.cos(roll) * y - math.sin(roll) * z


@inlined
def weigh(load, carried, targets, q, dq, down, dt, out):
    """``ArmLoad.weigh``: into ``out``, for the left and the right hand."""
    table, per_unit, most, _ = load
    factors, kept = np.empty((_NUM, 3)), np.empty(3)
    slopes, found = np.zeros((_NUM, 3)), np.empty(_COLUMNS)
    for side in range(2):
        for joint in range(_NUM):
            angle = q[_NUM * side + joint] * _MIRROR[side, joint]
            cos, sin = math.cos(angle), math.sin(angle)
            factors[joint, 0], factors[joint, 1], factors[joint, 2] = 1.0, cos, sin
            slopes[joint, 1], slopes[joint, 2] = -sin, cos
        along, squared, speed = 0.0, 0.0, 0.0
        for joint in range(_NUM):
            copy(factors[joint], kept)
            copy(slopes[joint], factors[joint])
            _product(table, per_unit, most, factors, found)
            copy(kept, factors[joint])
            own, lever = 0.0, 0.0
            for axis in range(3):
                weight = -_GRAVITY * (down[axis] * _SIDEWAYS[side, axis])
                own += weight * found[axis]
                lever += weight * found[3 + axis]
            at, rate = _NUM * side + joint, dq[_NUM * side + joint]
            torque = _STIFFNESS[joint] * (targets[at] - q[at]) - _DAMPING[joint] * rate
            left_over = torque * _MIRROR[side, joint] - own - lever * carried[side]
            along += left_over * lever
            squared += lever * lever
            speed += rate * rate
        step = along / (squared + _LITTLE)
        step = step / (1 + speed / _SWINGING_SQUARED)
        out[side] = clip(carried[side] + dt / _WEIGHING_S * step, 0.0, _LARGEST)
