"""``control.ik``, ``control.ik_pass``: what lies between the calls of placo and Eigen in inverse kinematics.

Kinematics, Jacobians, factorisation and the solver for bounds stay theirs: they take microseconds a call, and their
bits are in the order in which Eigen adds up.
"""

import math

import numpy as np

from gym_demohlm.control import reference
from gym_demohlm.control.kernels.compiler import compiled, inlined
from gym_demohlm.control.kernels.postures import clip

_HEIGHT, _PITCH = float(reference.TABLE_HEIGHTS[0]), float(reference.TABLE_PITCHES[0])
_ROWS, _COLUMNS = len(reference.TABLE_HEIGHTS), len(reference.TABLE_PITCHES)
_PER_METRE = (_ROWS - 1) / float(reference.TABLE_HEIGHTS[-1] - reference.TABLE_HEIGHTS[0])
_PER_RADIAN = (_COLUMNS - 1) / float(reference.TABLE_PITCHES[-1] - reference.TABLE_PITCHES[0])


@compiled
def window(previous, step, lowest, highest, straightest, lower, upper, bent):
    """Write the bounds of the next command (n,), and those of a torso pass, which bends its elbows.

    Args:
        previous: (n,) the command before.
        step: (n,) by how much it may change.
        lowest: (n,) and the next, the command's own bounds.
        highest: (n,).
        straightest: (n,) upper bounds of the torso pass; infinity for none.
        lower: (n,) written.
        upper: (n,) written.
        bent: (n,) written: the upper bounds of the torso pass.
    """
    for index in range(len(previous)):
        least, most = previous[index] - step[index], previous[index] + step[index]
        lower[index] = clip(lowest[index], least, most)
        upper[index] = clip(highest[index], least, most)
        bent[index] = min(upper[index], max(straightest[index], lower[index]))


@inlined
def _cell(value, first, a_unit, count):
    """``reference._cell``."""
    place = (value - first) * a_unit
    index = min(max(int(place), 0), count - 2)
    inside = 0.0 <= place <= count - 1
    return index, min(max(place - index, 0.0), 1.0), a_unit if inside else 0.0


@compiled
def pelvis_ahead(ahead, height, pitch):
    """``Reference.pelvis_ahead``, of a table of these distances."""
    i, u, rows = _cell(height, _HEIGHT, _PER_METRE, _ROWS)
    j, v, columns = _cell(pitch, _PITCH, _PER_RADIAN, _COLUMNS)
    a, b, c, d = ahead[i, j], ahead[i, j + 1], ahead[i + 1, j], ahead[i + 1, j + 1]
    low, high = a + v * (b - a), c + v * (d - c)
    return low + u * (high - low), (high - low) * rows, ((b - a) + u * (d - c - b + a)) * columns


@compiled
def advanced(ahead, here, T_world_base, height, pitch, pitch_column, position, base):
    """Write where the base is (3,) once the pelvis has backed off, and how it moves with the joints (3, n).

    Args:
        ahead: As in ``pelvis_ahead``.
        here: How far ahead the pelvis is now [m].
        T_world_base: (4, 4) of the base as it is now.
        height: [m] that the pelvis will have.
        pitch: [rad] that the torso will have.
        pitch_column: Which joint that is; the height is the first.
        position: (3,) written.
        base: (3, n) written; other columns stay as they are.
    """
    there, by_height, by_pitch = pelvis_ahead(ahead, height, pitch)
    distance = there - here
    for axis in range(3):
        along = T_world_base[axis, 0]
        position[axis] = T_world_base[axis, 3] + distance * along
        base[axis, 0], base[axis, pitch_column] = along * by_height, along * by_pitch


@compiled
def problem(q, posture, pull, columns, hand_scale, regularization, error_damping, hands, errors, jacobians, base, A, b):
    """Write the least-squares problem of posture, damping and hands; returns how many rows it has.

    Args:
        q: (n,) joints.
        posture: (n,) what they are pulled to.
        pull: (n,) square root of the pull's weight.
        columns: (n,) of the joints in Jacobians.
        hand_scale: (6,) square roots of the weights of a hand's position and orientation.
        regularization: Damping of each step.
        error_damping: More of it, times the hands' weighted squared error.
        hands: (2,) bool, which have a target.
        errors: (2, 6) ways to the targets, zero without one.
        jacobians: (2, 6, all joints) of the hands.
        base: (3, n) how the base moves with the joints.
        A: (rows, n) written.
        b: (rows,) written.
    """
    n = len(q)
    squares = np.empty(12)
    for hand in range(2):
        for axis in range(6):
            scaled = errors[hand, axis] * hand_scale[axis]
            squares[6 * hand + axis] = scaled * scaled
    s = squares  # added up in NumPy's order
    total = ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]))
    total = total + s[8] + s[9] + s[10] + s[11]
    damping = math.sqrt(regularization + error_damping * total)
    for row in range(n):
        for column in range(n):
            A[row, column] = A[n + row, column] = 0.0
        A[row, row], A[n + row, row] = pull[row], damping
        b[row], b[n + row] = pull[row] * (posture[row] - q[row]), 0.0
    row = 2 * n
    for hand in range(2):
        if hands[hand]:
            for axis in range(6):
                scale = hand_scale[axis]
                for column in range(n):
                    entry = jacobians[hand, axis, columns[column]]
                    A[row, column] = scale * (entry + base[axis, column] if axis < 3 else entry)
                b[row] = errors[hand, axis] * scale
                row += 1
    return row


@compiled
def head_rows(scale, columns, jacobian, base, p_world_head, T_world_head, row, A, b):
    """Add the three rows of the head, see ``problem``.

    Args:
        scale: Square root of their weight.
        columns: (n,).
        jacobian: (6, all joints) of the head.
        base: (3, n).
        p_world_head: (3,) its target.
        T_world_head: (4, 4) where it is.
        row: The first of them.
        A: (rows, n) written.
        b: (rows,) written.
    """
    for axis in range(3):
        for column in range(len(columns)):
            A[row + axis, column] = scale * (jacobian[axis, columns[column]] + base[axis, column])
        b[row + axis] = scale * (p_world_head[axis] - T_world_head[axis, 3])


@compiled
def within(change, q, lower, upper):
    """Return whether joints (n,) that change stay within their bounds."""
    for index in range(len(q)):
        if not (lower[index] - q[index] <= change[index] <= upper[index] - q[index]):
            return False
    return True


@compiled
def move(change, q, lower, upper):
    """Change joints (n,) in place, within their bounds; returns the largest change that was asked for."""
    largest = 0.0
    for index in range(len(q)):
        largest = max(largest, abs(change[index]))
        q[index] = clip(q[index] + change[index], lower[index], upper[index])
    return largest


@compiled
def lengths(errors):
    """Return the lengths of translations and of rotation vectors (2,) each of ways (2, 6)."""
    translations, rotations = np.empty(2), np.empty(2)
    for hand in range(2):
        e = errors[hand]
        translations[hand] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
        rotations[hand] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    return translations, rotations
