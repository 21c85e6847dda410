"""``control.odometry``, ``control.leg_ik``: the legs of one world, forwards and backwards."""

import math

import numpy as np

from gym_demohlm.control import leg_ik, odometry
from gym_demohlm.control.kernels.compiler import inlined
from gym_demohlm.control.kernels.postures import clip, hypot
from gym_demohlm.robot import g1

_NUM_LINKS = len(odometry.LINKS)
_AXES = np.array(["xyz".index(axis) for axis, _, _ in odometry.LINKS])
_OFFSETS = np.array([offset for _, offset, _ in odometry.LINKS])
_FIXED = np.array([bool(pitch) for _, _, pitch in odometry.LINKS])
_FIXED_COS = np.array([float(np.cos(pitch)) for _, _, pitch in odometry.LINKS])
_FIXED_SIN = np.array([float(np.sin(pitch)) for _, _, pitch in odometry.LINKS])
_SOLE_X, _SOLE_Y, _SOLE_Z, _ABOVE = *map(float, odometry.SOLE), float(odometry.SOLE[2] + 1.0)
_EPSILON, _BLEND = odometry.EPSILON, odometry.HEIGHT_BLEND
_SPREAD, _DROP = g1.HIP_SPREAD, g1.HIP_DROP
_AHEAD, _BELOW, _INCLINATION = leg_ik.AHEAD, leg_ik.BELOW, leg_ik.INCLINATION
_THIGH, _SHANK, _THIGH_ANGLE = g1.THIGH_LENGTH, g1.SHANK_LENGTH, leg_ik.THIGH_ANGLE
_THIGH_FROM_THERE = leg_ik.THIGH_FROM_THERE
_SHANK_SQUARED = _SHANK**2


@inlined
def _through_leg(x, y, z, cos, sin, mirror):
    """Bring a point of the ankle-roll frame into the pelvis frame, by the joints' cosines and sines."""
    for step in range(_NUM_LINKS):
        link = _NUM_LINKS - 1 - step
        c, s = cos[link], sin[link]
        if _AXES[link] == 0:
            y, z = c * y - s * z, s * y + c * z
        elif _AXES[link] == 1:
            x, z = c * x + s * z, c * z - s * x
        else:
            x, y = c * x - s * y, s * x + c * y
        if _FIXED[link]:
            c, s = _FIXED_COS[link], _FIXED_SIN[link]
            x, z = c * x + s * z, c * z - s * x
        x, y, z = x + _OFFSETS[link, 0], y + mirror * _OFFSETS[link, 1], z + _OFFSETS[link, 2]
    return x, y, z


@inlined
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@inlined
def odometry_estimate(down_x, down_y, down_z, gyro, legs, rates):
    """``odometry.estimate``: velocity ahead and aside, sole tilt, height, pelvis over the soles ahead and aside."""
    ux, uy, uz = -down_x, -down_y, -down_z
    fx, fy, fz = 1.0 - ux * ux, 0.0 - ux * uy, 0.0 - ux * uz
    length = max(math.sqrt(_dot(fx, fy, fz, fx, fy, fz)), 1e-6)
    fx, fy, fz = fx / length, fy / length, fz / length
    lx, ly, lz = uy * fz - uz * fy, uz * fx - ux * fz, ux * fy - uy * fx
    soles, moving = np.empty((2, 3)), np.empty((2, 3))
    height, upright = np.empty(2), np.empty(2)
    cos, sin = np.empty(_NUM_LINKS), np.empty(_NUM_LINKS)
    for side in range(2):
        mirror, first = 1.0 - 2.0 * side, _NUM_LINKS * side
        for link in range(_NUM_LINKS):
            cos[link], sin[link] = math.cos(legs[first + link]), math.sin(legs[first + link])
        x, y, z = _through_leg(_SOLE_X, _SOLE_Y, _SOLE_Z, cos, sin, mirror)
        ax, ay, az = _through_leg(_SOLE_X, _SOLE_Y, _ABOVE, cos, sin, mirror)
        for link in range(_NUM_LINKS):
            angle = legs[first + link] + _EPSILON * rates[first + link]
            cos[link], sin[link] = math.cos(angle), math.sin(angle)
        later_x, later_y, later_z = _through_leg(_SOLE_X, _SOLE_Y, _SOLE_Z, cos, sin, mirror)
        soles[side, 0], soles[side, 1], soles[side, 2] = x, y, z
        moving[side, 0] = (later_x - x) / _EPSILON + (gyro[1] * z - gyro[2] * y)
        moving[side, 1] = (later_y - y) / _EPSILON + (gyro[2] * x - gyro[0] * z)
        moving[side, 2] = (later_z - z) / _EPSILON + (gyro[0] * y - gyro[1] * x)
        height[side] = _dot(x, y, z, ux, uy, uz)
        upright[side] = _dot(ax - x, ay - y, az - z, ux, uy, uz)
    left = clip(0.5 + (height[1] - height[0]) / _BLEND, 0.0, 1.0)
    right = 1 - left
    mx = left * moving[0, 0] + right * moving[1, 0]
    my = left * moving[0, 1] + right * moving[1, 1]
    mz = left * moving[0, 2] + right * moving[1, 2]
    tilt = math.acos(clip(left * upright[0] + right * upright[1], -1.0, 1.0))
    sx, sy = (soles[0, 0] + soles[1, 0]) / 2.0, (soles[0, 1] + soles[1, 1]) / 2.0
    sz = (soles[0, 2] + soles[1, 2]) / 2.0
    above = -(left * height[0] + right * height[1])
    velocity = -_dot(fx, fy, fz, mx, my, mz), -_dot(lx, ly, lz, mx, my, mz)
    return *velocity, tilt, above, -_dot(fx, fy, fz, sx, sy, sz), -_dot(lx, ly, lz, sx, sy, sz)


@inlined
def _planar(forward, down, upper, upper_squared):
    """``leg_ik.planar``: thigh, knee."""
    distance = clip(math.sqrt(forward * forward + down * down), 0.22, upper + _SHANK - 0.004)
    squared = distance * distance
    knee = np.pi - math.acos(clip((upper_squared + _SHANK_SQUARED - squared) / (2 * upper * _SHANK), -1.0, 1.0))
    lean = math.acos(clip((upper_squared + squared - _SHANK_SQUARED) / (2 * upper * distance), -1.0, 1.0))
    return -math.atan2(forward, down) - lean, knee


_THIGH_SQUARED, _FROM_THERE_SQUARED = _THIGH**2, _THIGH_FROM_THERE**2


@inlined
def _heading(x, y, z, cb, sb, ct, st):
    """Turn a vector by R_heading_pelvis, from the cosines and sines of bank and tilt."""
    y, z = cb * y - sb * z, sb * y + cb * z
    return ct * x + st * z, y, ct * z - st * x


@inlined
def solve_leg(x, y, z, sole_yaw, tilt, bank, side):
    """``leg_ik.solve`` of one leg, side 1 for the left and -1 for the right: its six joints."""
    ct, st, cb, sb = math.cos(tilt), math.sin(tilt), math.cos(bank), math.sin(bank)
    hx, hy, hz = _heading(0.0, 0.0 + _SPREAD * side, 0.0 - _DROP, cb, sb, ct, st)
    pitch = _planar(x - hx, hypot(y - hy, z - hz), _THIGH, _THIGH_SQUARED)[0] - tilt
    cp, sp = math.cos(pitch), math.sin(pitch)
    ax, az = 0.0 + _AHEAD, 0.0 - _BELOW
    ax, ay, az = _heading(cp * ax + sp * az, 0.0, cp * az - sp * ax, cb, sb, ct, st)
    vx, vy, vz = hx + ax - x, hy + ay - y, hz + az - z
    cy, sy = math.cos(-sole_yaw), math.sin(-sole_yaw)
    vx, vy = cy * vx - sy * vy, sy * vx + cy * vy
    ankle_roll = math.atan2(vy, vz)
    thigh, knee = _planar(-vx, hypot(vy, vz), _THIGH_FROM_THERE, _FROM_THERE_SQUARED)
    ankle_pitch = -(thigh + knee)
    thigh, knee = thigh - _THIGH_ANGLE, knee + _THIGH_ANGLE
    angles = (thigh - _INCLINATION, -ankle_roll, sole_yaw, -tilt, -bank)
    first = _in_pelvis(1.0, 0.0, 0.0, angles)
    second = _in_pelvis(0.0, 1.0, 0.0, angles)
    third = _in_pelvis(0.0, 0.0, 1.0, angles)
    hip_pitch = math.atan2(third[0], third[2]) + _INCLINATION
    hip_roll = math.atan2(-third[1], hypot(third[0], third[2]))
    hip_yaw = math.atan2(first[1], second[1])
    return hip_pitch, hip_roll, hip_yaw, knee, ankle_pitch, ankle_roll


@inlined
def _in_pelvis(x, y, z, angles):
    """Turn a vector about y, x, z, y and x."""
    c, s = math.cos(angles[0]), math.sin(angles[0])
    x, z = c * x + s * z, c * z - s * x
    c, s = math.cos(angles[1]), math.sin(angles[1])
    y, z = c * y - s * z, s * y + c * z
    c, s = math.cos(angles[2]), math.sin(angles[2])
    x, y = c * x - s * y, s * x + c * y
    c, s = math.cos(angles[3]), math.sin(angles[3])
    x, z = c * x + s * z, c * z - s * x
    c, s = math.cos(angles[4]), math.sin(angles[4])
    return x, c * y - s * z, s * y + c * z
