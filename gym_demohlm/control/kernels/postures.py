"""``control.attitude``, ``control.reference``: how torso, pelvis and feet of one world go together."""

import math

from gym_demohlm.control import attitude, reference
from gym_demohlm.control.kernels.compiler import inlined
from gym_demohlm.robot import g1

_WAIST_ROLL, _WAIST_BEND = attitude.WAIST_ROLL, attitude.WAIST_BEND
_LARGEST_BANK, _WAIST_LIMIT = attitude.LARGEST_BANK, attitude.WAIST_LIMIT
_HEIGHT, _HEIGHT_STEP = reference.TABLE_HEIGHTS[0], reference.TABLE_HEIGHTS[1] - reference.TABLE_HEIGHTS[0]
_PITCH, _PITCH_STEP = reference.TABLE_PITCHES[0], reference.TABLE_PITCHES[1] - reference.TABLE_PITCHES[0]
_LAST_ROW, _LAST_COLUMN = len(reference.TABLE_HEIGHTS) - 1.001, len(reference.TABLE_PITCHES) - 1.001
_LEAN_BACK, _LEAN_BACK_SLOPE = reference.LEAN_BACK, reference.LEAN_BACK_SLOPE
_LEAN_BACK_HEIGHT, _LEAN_ASIDE = reference.LEAN_BACK_HEIGHT, reference.LEAN_ASIDE
_MASS, _HIP_DROP, _LATERAL_SHIFT = g1.MASS, g1.HIP_DROP, reference.LATERAL_SHIFT


@inlined
def clip(x, low, high):
    """``np.clip`` of a number."""
    x = x if x > low else low
    return x if x < high else high


@inlined
def copy(source, into):
    """Fill an array with the first numbers of another."""
    for index in range(len(into)):
        into[index] = source[index]


@inlined
def hypot(x, y):
    """``arithmetic.hypot``."""
    return math.sqrt(x * x + y * y)


@inlined
def lean(roll, pitch, yaw):
    """``attitude.lean``."""
    ahead, left, up = math.cos(roll) * math.sin(pitch), -math.sin(roll), math.cos(roll) * math.cos(pitch)
    x, y = math.cos(yaw) * ahead - math.sin(yaw) * left, math.sin(yaw) * ahead + math.cos(yaw) * left
    return math.atan2(x, up), math.atan2(-y, hypot(x, up))


@inlined
def pelvis_attitude(ahead, aside, tilt):
    """``attitude.pelvis_attitude``."""
    waist_ahead, waist_aside = ahead - tilt, clip(aside, -_WAIST_ROLL, _WAIST_ROLL)
    share = min(_WAIST_BEND / max(hypot(waist_ahead, waist_aside), _WAIST_BEND), 1.0)
    bank = clip(aside - share * waist_aside, -_LARGEST_BANK, _LARGEST_BANK)
    return ahead - share * waist_ahead, bank


@inlined
def waist_angles(roll, pitch, yaw, tilt, bank):
    """``attitude.waist_angles``."""
    x0, y0, z0 = -math.sin(tilt), math.sin(bank) * math.cos(tilt), math.cos(bank) * math.cos(tilt)
    x1, y1 = math.cos(yaw) * x0 + math.sin(yaw) * y0, math.cos(yaw) * y0 - math.sin(yaw) * x0
    ux, uy, uz = -math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)
    length = max(hypot(y1, z0), 1e-6)
    waist_roll = math.asin(clip(uy / length, -1.0, 1.0)) - math.atan2(y1, z0)
    waist_roll = clip(waist_roll, -_WAIST_LIMIT, _WAIST_LIMIT)
    z1 = math.cos(waist_roll) * z0 - math.sin(waist_roll) * y1
    waist_pitch = math.atan2(x1 * uz - z1 * ux, x1 * ux + z1 * uz)
    return waist_roll, clip(waist_pitch, -_WAIST_LIMIT, _WAIST_LIMIT)


@inlined
def in_torso(x, y, z, yaw, roll, pitch):
    """``attitude.in_torso``."""
    x, y = math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x
    y, z = math.cos(roll) * y + math.sin(roll) * z, math.cos(roll) * z - math.sin(roll) * y
    return math.cos(pitch) * x - math.sin(pitch) * z, y, math.cos(pitch) * z + math.sin(pitch) * x


@inlined
def roll_pitch(x, y, z):
    """``attitude.roll_pitch``."""
    return math.atan2(-y, -z), math.atan2(x, hypot(y, z))


@inlined
def gravity(w, x, y, z):
    """``features.gravity``."""
    return 2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1


@inlined
def balanced(roll, pitch, yaw, height):
    """``reference.balanced``: roll and pitch."""
    furthest_back = _LEAN_BACK + _LEAN_BACK_SLOPE * (height - _LEAN_BACK_HEIGHT)
    lowest = math.sin(furthest_back) / math.cos(furthest_back)
    ahead, aside = math.cos(yaw), math.sin(yaw)
    pitch = max(pitch, math.atan((lowest - aside * (math.sin(roll) / math.cos(roll))) / ahead))
    further = math.asin(clip((_LEAN_ASIDE - abs(aside) * math.sin(pitch)) / ahead, 0.0, 1.0))
    roll = max(roll, -further) if aside > 0 else min(roll, further)
    return roll, pitch


@inlined
def statics(table, height, pitch):
    """``Reference.statics``: ankle shift, pelvis pitch, sag of hip pitch, knee and ankle pitch."""
    row = clip((height - _HEIGHT) / _HEIGHT_STEP, 0.0, _LAST_ROW)
    column = clip((pitch - _PITCH) / _PITCH_STEP, 0.0, _LAST_COLUMN)
    i, j = int(row), int(column)
    u, v = row - i, column - j
    a, b, c, d = table[i, j], table[i, j + 1], table[i + 1, j], table[i + 1, j + 1]
    shift = (1 - u) * ((1 - v) * a[0] + v * b[0]) + u * ((1 - v) * c[0] + v * d[0])
    tilt = (1 - u) * ((1 - v) * a[1] + v * b[1]) + u * ((1 - v) * c[1] + v * d[1])
    hip = (1 - u) * ((1 - v) * a[2] + v * b[2]) + u * ((1 - v) * c[2] + v * d[2])
    knee = (1 - u) * ((1 - v) * a[3] + v * b[3]) + u * ((1 - v) * c[3] + v * d[3])
    ankle = (1 - u) * ((1 - v) * a[4] + v * b[4]) + u * ((1 - v) * c[4] + v * d[4])
    return shift, tilt, hip, knee, ankle


@inlined
def footing(table, command, moment_ahead, moment_aside):
    """``Reference.footing``: ahead, aside, tilt, bank."""
    height, roll, pitch, yaw = command[3], command[4], command[5], command[6]
    forward, right = lean(roll, pitch, yaw)
    shift, tilt, _, _, _ = statics(table, height, forward)
    tilt, bank = pelvis_attitude(forward, right, tilt)
    x, y = moment_ahead / _MASS, moment_aside / _MASS
    shift = shift + math.cos(yaw) * x - math.sin(yaw) * y
    aside = math.sin(yaw) * x + math.cos(yaw) * y - _LATERAL_SHIFT * math.sin(right)
    return shift - _HIP_DROP * math.sin(tilt), aside, tilt, bank


@inlined
def capture_point(table, command, moment_ahead, moment_aside, over_ahead, over_aside, vx, vy, sole_middle, g):
    """``Reference.capture``."""
    ahead, aside, _, _ = footing(table, command, moment_ahead, moment_aside)
    time = math.sqrt(command[3] / g)
    return over_ahead - (-ahead - sole_middle) + vx * time, over_aside - -aside + vy * time
