"""``control.gait_clock`` and ``control.reference``: what of a command is followed, and targets of legs and waist."""

import math
from typing import NamedTuple

import numpy as np

from gym_demohlm.control import features, gait_clock, reference
from gym_demohlm.control.kernels.arms import arms_moment
from gym_demohlm.control.kernels.compiler import inlined
from gym_demohlm.control.kernels.legs import solve_leg
from gym_demohlm.control.kernels.postures import balanced, clip, copy, footing, lean, statics, waist_angles
from gym_demohlm.control.settings import Gait
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

_WALK_HEIGHT, (_PITCH_BACK, _PITCH_AHEAD), _WALK_YAW = reference.WALK_HEIGHT, reference.WALK_PITCH, reference.WALK_YAW
_NEARLY_THERE, _THRESHOLD = reference.NEARLY_THERE, gait_clock.WALK_THRESHOLD
_SQUARE_UP = gait_clock.STEPS_TO_SQUARE_UP
_UPRIGHT_ROLL, _OUTSIDE = reference.UPRIGHT_ROLL, reference.OUTSIDE
_WIDENS, _LARGEST_TILT, _PUSHED_AHEAD = reference.WIDENS, reference.LARGEST_TILT, gait_clock.PUSHED_AHEAD
_HIP_SPREAD, _SOLE_DROP = g1.HIP_SPREAD, g1.SOLE_DROP
_HIP_YAW = g1.LEG_JOINTS.index("left_hip_yaw")
_HIP_PITCH, _HIP_ROLL, _KNEE, _ANKLE_PITCH, _ANKLE_ROLL = 0, 1, 3, 4, 5
_TURNS, _SCALE = reference.TURNS, features.ACTION_SCALE
_GRAVITY, _ARMS_SAG, _HIP_ROLL_SAG = reference.GRAVITY, reference.ARMS_SAG, reference.HIP_ROLL_SAG
_LOAD_UP, _LOAD_AHEAD = reference.TORSO_LOAD_UP, reference.TORSO_LOAD_AHEAD
_WAIST_STIFFNESS = reference.WAIST_STIFFNESS


class GaitNumbers(NamedTuple):
    """A ``Gait`` as kernels take it; ``capture`` is the margins, where ``captures`` says that there are any."""

    period_s: float
    swing: float
    lift: float
    sway: float
    widen: float
    placement_s: float
    inward: float
    spread: float
    recovery_s: float
    recovery_speed: float
    recovery_spread: float
    recovery_period_s: float
    swing_upright: float
    ankle_upright: float
    ankle_damping_s: float
    turn: tuple[float, ...]
    turns: bool
    rest_phases: tuple[float, float]
    captures: bool
    capture: tuple[float, float, float]

    @classmethod
    def of(cls, gait: Gait) -> "GaitNumbers":
        """Return the numbers of a gait."""
        ahead, behind, beside = gait.capture or (0.0, 0.0, 0.0)
        plain = {name: float(getattr(gait, name)) for name in cls._fields[: cls._fields.index("turn")]}
        return cls(
            **plain,
            turn=gait.turn,
            turns=any(gait.turn),
            rest_phases=gait.rest_phases,
            captures=gait.capture is not None,
            capture=(float(ahead), float(behind), float(beside)),
        )


@inlined
def admissible(command, current, standing, goal):
    """``reference.admissible``: into ``goal`` (7,)."""
    copy(command, goal)
    bent = current[3] < _WALK_HEIGHT - 0.01 or current[5] > _PITCH_AHEAD + 0.02
    bent = bent or abs(current[4]) > 0.1 or abs(current[6]) > _WALK_YAW + 0.05
    on_its_way = False
    for index in range(4):
        on_its_way = on_its_way or abs(goal[3 + index] - current[3 + index]) > _NEARLY_THERE[index]
    if bent or (standing and on_its_way):
        goal[0], goal[1], goal[2] = 0.0, 0.0, 0.0
    goal[4], goal[5] = balanced(goal[4], goal[5], goal[6], current[3])
    if not standing:
        goal[3] = max(goal[3], _WALK_HEIGHT)
        goal[4] = 0.0
        goal[5] = clip(goal[5], _PITCH_BACK, _PITCH_AHEAD)
        goal[6] = clip(goal[6], -_WALK_YAW, _WALK_YAW)


@inlined
def pushed(velocity, command, gait):
    """``gait_clock.pushed``."""
    x, y = _PUSHED_AHEAD * (velocity[0] - command[0]), velocity[1] - command[1]
    return x * x + y * y > gait.recovery_speed * gait.recovery_speed


@inlined
def recovery_share(recovers):
    """``gait_clock.recovery_share``."""
    return min(2 * recovers, 1.0)


@inlined
def period(recovers, gait):
    """``gait_clock.period``."""
    return gait.period_s + recovery_share(recovers) * (gait.recovery_period_s - gait.period_s)


@inlined
def advance_clock(phase, stopped, standing, recovers, velocity, startled, pushed, gait):
    """``gait_clock.advance_clock``."""
    if gait.recovery_s != 0.0:
        recovers = 1.0 if pushed else max(recovers - CONTROL_DT / gait.recovery_s, 0.0)
    tick = CONTROL_DT / period(recovers, gait)
    walk = startled
    for index in range(3):
        walk = walk or abs(velocity[index]) > _THRESHOLD[index]
    stopped = 0.0 if walk else min(stopped + tick, 10.0)
    moved = (phase + tick) % 1.0
    both_down = (moved % 0.5) >= gait.swing
    stands = not walk and (standing or (stopped >= _SQUARE_UP and both_down))
    rest = gait.rest_phases[0] if moved < 0.5 else gait.rest_phases[1]
    rest = phase if standing else rest
    return rest if stands else moved, stopped, stands, 0.0 if stands else recovers


@inlined
def turns_feet(standing, torso):
    """``reference.action_scale``: the share that hip yaws have of theirs; ``torso`` is height, roll, pitch, yaw."""
    most = (_WALK_HEIGHT - torso[0]) / _OUTSIDE[0]
    most = max(most, (abs(torso[1]) - _UPRIGHT_ROLL) / _OUTSIDE[1])
    most = max(most, (torso[2] - _PITCH_AHEAD) / _OUTSIDE[2])
    most = max(most, (_PITCH_BACK - torso[2]) / _OUTSIDE[3])
    most = max(most, (abs(torso[3]) - _WALK_YAW) / _OUTSIDE[4])
    return clip(most, 0.0, 1.0) if standing else 1.0


@inlined
def _turn(c, phase, vx, vy, yaw_rate):
    """``reference._turn``."""
    angle = 2 * np.pi * phase
    c1, s1, c2, s2 = math.cos(angle), math.sin(angle), math.cos(2 * angle), math.sin(2 * angle)
    c3, s3 = math.cos(3 * angle), math.sin(3 * angle)
    total = 0.0 + c[0] * c1 + c[1] * s1 + c[2] * c3 + c[3] * s3
    total = total + c[4] * (vx * c1) + c[5] * (vx * s1) + c[6] * (vx * c3) + c[7] * (vx * s3)
    return total + c[8] * (vy * c2) + c[9] * (vy * s2) + c[10] * (yaw_rate * c2) + c[11] * (yaw_rate * s2)


@inlined
def reference_targets(
    table, load, gait, command, phase, stopped, standing, recovers, velocity, arms, carried, attitude, out
):
    """``Reference.__call__``: into ``out`` (15,)."""
    vx, vy, yaw_rate = command[0], command[1], command[2]
    height, roll, pitch, yaw = command[3], command[4], command[5], command[6]
    moment_ahead, moment_aside = arms_moment(load, command, arms, carried)
    ahead, aside, tilt, bank = footing(table, command, moment_ahead, moment_aside)
    walking = not standing
    half_stride = 0.5 * (1 - gait.swing) * period(recovers, gait)
    sway = gait.sway * math.sin(2 * np.pi * (phase + 0.05)) if walking else 0.0
    extra_x = clip(velocity[0] - vx, -0.6, 0.6) * gait.placement_s
    extra_y = clip(velocity[1] - vy, -0.6, 0.6) * gait.placement_s
    spread = gait.spread + recovery_share(recovers) * (gait.recovery_spread - gait.spread)
    apart = spread + (_HIP_SPREAD - spread) * min(stopped / _WIDENS, 1.0)
    spread = apart + gait.widen * abs(vy) if walking else _HIP_SPREAD + 0.0
    unplanned_pitch = clip(attitude[0] - tilt, -_LARGEST_TILT, _LARGEST_TILT)
    unplanned_roll = clip(attitude[1] - bank, -_LARGEST_TILT, _LARGEST_TILT)
    against_pitch = gait.ankle_upright * unplanned_pitch + gait.ankle_damping_s * clip(attitude[2], -3.0, 3.0)
    against_roll = gait.ankle_upright * unplanned_roll + gait.ankle_damping_s * clip(attitude[3], -3.0, 3.0)
    turn = _turn(gait.turn, phase, vx, vy, yaw_rate) if gait.turns and walking else 0.0
    # What joints give under the weight, ``Reference.sag``.
    _, _, sag_hip, sag_knee, sag_ankle = statics(table, height, lean(roll, pitch, yaw)[0])
    torque_ahead, torque_aside = _GRAVITY * moment_ahead, _GRAVITY * moment_aside
    along = math.cos(yaw) * torque_ahead - math.sin(yaw) * torque_aside
    sag_hip, sag_knee = sag_hip + along * _ARMS_SAG[0], sag_knee + along * _ARMS_SAG[1]
    sag_ankle = sag_ankle + along * _ARMS_SAG[2]
    for foot in range(2):
        side, leg = 1.0 - 2.0 * foot, 6 * foot
        own = (phase + 0.5 * foot) % 1.0
        u = clip(own / gait.swing, 0.0, 1.0)
        v = (own - gait.swing) / (1 - gait.swing)
        eased, swings = u * u * (3 - 2 * u), own < gait.swing
        progress = ((-1 + 2 * eased if swings else 1 - 2 * v) if walking else 0.0) * half_stride
        reach = (eased if swings else 1 - v) if walking else 0.0
        wave = math.sin(np.pi * u)
        lift = gait.lift * (wave * wave) if swings and walking else 0.0
        x = vx * progress + extra_x * reach + ahead
        beside = extra_y * (gait.inward if extra_y * side < 0 else 1.0)
        y = vy * progress + beside * reach + (sway + aside) + spread * side
        z = lift - height + _SOLE_DROP
        leg_tilt, leg_bank = tilt, bank
        if gait.swing_upright != 0.0:
            share = gait.swing_upright * ((eased if swings else max(1 - 4 * v, 0.0)) if walking else 0.0)
            leg_tilt, leg_bank = tilt + share * unplanned_pitch, bank + share * unplanned_roll
        joints = solve_leg(x, y, z, yaw_rate * progress, leg_tilt, leg_bank, side)
        for joint in range(6):
            out[leg + joint] = joints[joint]
        if (gait.ankle_upright != 0.0 or gait.ankle_damping_s != 0.0) and not (swings and walking):
            out[leg + _ANKLE_PITCH] += against_pitch
            out[leg + _ANKLE_ROLL] += against_roll
        if gait.turns:
            out[leg + _HIP_YAW] += turn
        alone = min(min(own - gait.swing, 1 - own) / (0.5 - gait.swing), 1.0)
        bears = 1.0 if standing else 2 * max(alone, 0.0)
        out[leg + _HIP_PITCH] += bears * sag_hip
        out[leg + _KNEE] += bears * sag_knee
        out[leg + _ANKLE_PITCH] += bears * sag_ankle
        out[leg + _HIP_ROLL] += side * _HIP_ROLL_SAG * max(bears - 1, 0.0)
    out[12] = yaw
    waist_roll, waist_pitch = waist_angles(roll, pitch, yaw, tilt, bank)
    out[13] = waist_roll + (torque_aside - _LOAD_UP * math.sin(roll)) / _WAIST_STIFFNESS
    load_ahead = _LOAD_UP * math.sin(pitch) + _LOAD_AHEAD * math.cos(pitch)
    out[14] = waist_pitch + -(torque_ahead + load_ahead) / _WAIST_STIFFNESS


@inlined
def act(action, standing, torso, lower, upper, out):
    """Add an action to targets (15,) in place, and bring them into the joints' ranges."""
    turns = turns_feet(standing, torso)
    for joint in range(len(_SCALE)):
        scale = turns * _SCALE[joint] if _TURNS[joint] else _SCALE[joint]
        out[joint] = clip(out[joint] + action[joint] * scale, lower[joint], upper[joint])
