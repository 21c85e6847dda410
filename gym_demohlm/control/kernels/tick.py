"""``control.tick``: all worlds of a simulation through a tick, before and after the policy acts."""

import math
from typing import NamedTuple

import numpy as np

from gym_demohlm.control import features, gait_clock, reference, tick, velocity_map
from gym_demohlm.control.kernels.arms import arms_moment, weigh
from gym_demohlm.control.kernels.compiler import compiled
from gym_demohlm.control.kernels.gait import GaitNumbers, act, admissible, advance_clock, pushed, reference_targets
from gym_demohlm.control.kernels.legs import odometry_estimate
from gym_demohlm.control.kernels.postures import balanced, capture_point, clip, copy, gravity, in_torso, roll_pitch
from gym_demohlm.control.odometry import FILTER
from gym_demohlm.control.settings import Settings
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

_FRAME, _HISTORY, _LEGS, _LOWER = features.FRAME_SIZE, tick.HISTORY_SIZE, tick.LEGS, reference.NUM_LOWER
_JOINTS, _ARM_JOINTS = len(features.OBSERVED_JOINTS), len(features.OBSERVED_ARM_JOINTS)
_SEEN, _SEEN_ARMS = features.OBSERVED_INDEX, features.OBSERVED_ARM_INDEX
_ACTION, _SLEWED, _CLOCK = tick.LAST_ACTION.start, tick.SLEWED.start, tick.CLOCK
_VELOCITY, _ARMS, _CARRIED, _TRIM = tick.VELOCITY.start, tick.ARMS.start, tick.CARRIED.start, tick.TRIM.start
_ACTION_SIZE, _STATE_SIZE, _SIZE = features.ACTION_SIZE, tick.STATE_SIZE, features.OBSERVATION_SIZE
_REST, _WHILE_STANDING, _CONSTANT = tick.REST, tick.WHILE_STANDING, tick.CONSTANT
_LARGEST_ARM_SPEED = tick.LARGEST_ARM_SPEED
_GYRO_SCALE, _VELOCITY_SCALE = features.GYRO_SCALE, features.VELOCITY_SCALE
_ARM_VELOCITY_SCALE = features.ARM_VELOCITY_SCALE
_COMMAND_SCALE, _COMMAND_OFFSET = features.COMMAND_SCALE, features.COMMAND_OFFSET
_STARTLE_SPEED, _STARTLE_TILT = gait_clock.STARTLE_SPEED, gait_clock.STARTLE_TILT
_SOLE_MIDDLE, _GRAVITY = reference.SOLE_MIDDLE, reference.GRAVITY
_COMMAND = 7
_HOME = g1.HOME[:_LOWER]
_MAP_INDEX, _MAP_CENTRE, _MAP_SCALE = velocity_map.INDEX, velocity_map.CENTRE, velocity_map.SCALE
_MAP_BOUND, _MAP_LARGEST, _MAP_TERMS = velocity_map.BOUND, velocity_map.LARGEST, velocity_map.TERMS


class Numbers(NamedTuple):
    """What is the same for all worlds and ticks: a ``Tick`` as kernels take it."""

    gait: GaitNumbers
    table: np.ndarray
    load: tuple[np.ndarray, float, float, np.ndarray]
    slew: np.ndarray
    further: np.ndarray
    velocity_map: np.ndarray
    trim_rate: float
    trim_fade: float
    trim_limits: np.ndarray
    use_reference: bool

    @classmethod
    def of(cls, pose: reference.Reference, settings: Settings) -> "Numbers":
        """Return the numbers of a controller."""
        arms = pose.arm_load
        product = arms.product
        return cls(
            gait=GaitNumbers.of(pose.gait),
            table=pose.posture_table,
            load=(
                product.matrix * product.row_step,
                1.0 / product.row_step,
                product.bound / product.row_step,
                arms.home,
            ),
            slew=np.array(settings.slew) * CONTROL_DT,
            further=np.array(settings.gain) - 1.0,
            velocity_map=velocity_map.coefficients(settings.velocity_map),
            trim_rate=settings.trim.rate * CONTROL_DT,
            trim_fade=1 - settings.trim.fade * CONTROL_DT,
            trim_limits=np.array(settings.trim.limits, dtype=np.float64),
            use_reference=not isinstance(pose, reference.Rest),
        )


@compiled
def add_velocity(coefficients, slewed, columns, told):
    """Add ``velocity_map.further``.

    Args:
        coefficients: (2, NUM_TERMS), or (0, NUM_TERMS) for nothing.
        slewed: (7,) command.
        columns: (6,) of which the last is one; the others are written.
        told: (7,), to whose velocities it is added.
    """
    if len(coefficients) == 0:
        return
    for index in range(len(_MAP_INDEX)):
        scaled = (slewed[_MAP_INDEX[index]] - _MAP_CENTRE[index]) * _MAP_SCALE[index]
        columns[index] = clip(scaled, -_MAP_BOUND, _MAP_BOUND)
    for row in range(len(coefficients)):
        total = 0.0
        for term in range(len(_MAP_TERMS)):
            value = columns[_MAP_TERMS[term, 0]]
            for factor in range(1, _MAP_TERMS.shape[1]):
                value *= columns[_MAP_TERMS[term, factor]]
            total += value * coefficients[row, term]
        told[row] += clip(total, -_MAP_LARGEST, _MAP_LARGEST)


@compiled
def perceive(numbers, state, quat_wxyz, gyro, q, dq, commands, arms_column, after, observation, told, attitude):
    """``Tick.perceive`` and ``Situation.observation``.

    Args:
        numbers: Of the controller.
        state: (n, STATE_SIZE) after the tick before.
        quat_wxyz: (n, 4); this and the next three as ``Proprioception``.
        gyro: (n, 3).
        q: (n, 29).
        dq: (n, 29).
        commands: (n, 21 or more) velocity and torso first.
        arms_column: Where the arms' joints begin in them.
        after: (n, STATE_SIZE), written: the state after this tick, the action still that of the tick before.
        observation: (n, OBSERVATION_SIZE), written.
        told: (n, 7), written: the command with gain and trim.
        attitude: (n, 4), written: pitch and roll of the pelvis, and their rates.
    """
    gait, limits = numbers.gait, numbers.trim_limits
    goal, joints, rates = np.empty(_COMMAND), np.empty(_JOINTS), np.empty(_JOINTS)
    down_torso, measured, correction = np.empty(3), np.empty(5), np.empty(5)
    columns = np.ones(len(_MAP_INDEX) + 1)
    for world in range(len(state)):
        before, now, seen = state[world], after[world], observation[world]
        for index in range(_JOINTS):
            joints[index], rates[index] = q[world, _SEEN[index]], dq[world, _SEEN[index]]
        turn = gyro[world]
        down = gravity(quat_wxyz[world, 0], quat_wxyz[world, 1], quat_wxyz[world, 2], quat_wxyz[world, 3])
        # The history, the newest frame last.
        copy(before[_FRAME:], now[: _HISTORY - _FRAME])
        frame = now[_HISTORY - _FRAME : _HISTORY]
        for axis in range(3):
            frame[axis], frame[3 + axis] = _GYRO_SCALE * turn[axis], down[axis]
        for index in range(_JOINTS):
            frame[6 + index], frame[6 + _JOINTS + index] = joints[index], _VELOCITY_SCALE * rates[index]
        copy(before[_ACTION:], now[_ACTION:_SLEWED])
        # Command and clock move on.
        current, slewed = before[_SLEWED:_CLOCK], now[_SLEWED:_CLOCK]
        stood = before[_CLOCK + 2] > 0.5
        admissible(commands[world], current, stood, goal)
        constant = True
        for index in range(_COMMAND):
            change, most = goal[index] - current[index], numbers.slew[index]
            constant = constant and abs(change) < _CONSTANT
            slewed[index] = current[index] + clip(change, -most, most)
        vx, vy, sole_tilt, height, over_ahead, over_aside = odometry_estimate(
            down[0], down[1], down[2], turn, joints[:_LEGS], rates[:_LEGS]
        )
        velocity, old = now[_VELOCITY:_ARMS], before[_VELOCITY:_ARMS]
        velocity[0] = old[0] + FILTER * (clip(vx, -2.0, 2.0) - old[0])
        velocity[1] = old[1] + FILTER * (clip(vy, -2.0, 2.0) - old[1])
        waist = joints[_LEGS:_LOWER]
        tx, ty, tz = in_torso(down[0], down[1], down[2], waist[0], waist[1], waist[2])
        down_torso[0], down_torso[1], down_torso[2] = tx, ty, tz
        arms_before, carried = before[_ARMS:_CARRIED], now[_CARRIED:_TRIM]
        weigh(
            numbers.load, before[_CARRIED:_TRIM], arms_before, joints[_LOWER:], rates[_LOWER:], down_torso,
            CONTROL_DT, carried,
        )  # fmt: skip
        if gait.captures:
            moment_ahead, moment_aside = arms_moment(numbers.load, current, arms_before, carried)
            ahead, aside = capture_point(
                numbers.table, current, moment_ahead, moment_aside, over_ahead, over_aside, velocity[0], velocity[1],
                _SOLE_MIDDLE, _GRAVITY,
            )  # fmt: skip
            startled = ahead > gait.capture[0] or ahead < -gait.capture[1] or abs(aside) > gait.capture[2]
        else:
            startled = abs(velocity[0]) > _STARTLE_SPEED[0] or abs(velocity[1]) > _STARTLE_SPEED[1]
        startled = startled or sole_tilt > _STARTLE_TILT
        phase, stopped, standing, recovers = advance_clock(
            before[_CLOCK], before[_CLOCK + 1], stood, max(-before[_CLOCK + 2], 0.0), slewed, startled,
            pushed(velocity, slewed, gait), gait,
        )  # fmt: skip
        now[_CLOCK], now[_CLOCK + 1], now[_CLOCK + 2] = phase, stopped, 1.0 if standing else 0.0 - recovers
        # The slow correction.
        measured[0], measured[1] = -(down[0] * turn[0] + down[1] * turn[1] + down[2] * turn[2]), height
        measured[2], measured[3] = roll_pitch(tx, ty, tz)
        measured[4] = waist[0]
        for index in range(5):
            trim = before[_TRIM + index]
            further = trim + numbers.trim_rate * (slewed[2 + index] - measured[index])
            learns = constant and standing == _WHILE_STANDING[index]
            limit = limits[index]
            correction[index] = clip(further, -limit, limit) if learns else numbers.trim_fade * trim
        for index in range(_COMMAND):
            told[world, index] = slewed[index] + numbers.further[index] * (slewed[index] - _REST[index])
        add_velocity(numbers.velocity_map, slewed, columns, told[world])
        roll, pitch, yaw = told[world, 4], told[world, 5], told[world, 6]
        plain_roll, plain_pitch = balanced(roll, pitch, yaw, slewed[3])
        trimmed_roll, trimmed_pitch = balanced(
            roll + correction[2], pitch + correction[3], yaw + correction[4], slewed[3]
        )
        correction[1] = (told[world, 3] + correction[1]) - told[world, 3]
        correction[2], correction[3] = trimmed_roll - plain_roll, trimmed_pitch - plain_pitch
        correction[4] = (yaw + correction[4]) - yaw
        for index in range(5):
            told[world, 2 + index] += correction[index]
            now[_TRIM + index] = correction[index]
        pelvis_roll, pelvis_pitch = roll_pitch(down[0], down[1], down[2])
        attitude[world, 0], attitude[world, 1] = pelvis_pitch, pelvis_roll
        attitude[world, 2], attitude[world, 3] = turn[1], turn[0]
        # What the policy sees.
        copy(now, seen[:_SLEWED])
        first = _SLEWED
        for index in range(_ARM_JOINTS):
            target = commands[world, arms_column + _SEEN_ARMS[index]]
            now[_ARMS + index] = seen[first + index] = target
            speed = clip((target - arms_before[index]) / CONTROL_DT, -_LARGEST_ARM_SPEED, _LARGEST_ARM_SPEED)
            seen[_SIZE - 2 - _ARM_JOINTS + index] = _ARM_VELOCITY_SCALE * speed
        first += _ARM_JOINTS
        for index in range(_COMMAND):
            seen[first + index] = (told[world, index] - _COMMAND_OFFSET[index]) * _COMMAND_SCALE[index]
        first += _COMMAND
        walks = 0.0 if standing else 1.0
        angle = 2 * np.pi * phase
        seen[first], seen[first + 1] = math.sin(angle) * walks, math.cos(angle) * walks
        seen[first + 2] = 1.0 - walks
        seen[first + 3], seen[first + 4] = velocity[0], velocity[1]
        seen[_SIZE - 2], seen[_SIZE - 1] = carried[0], carried[1]


@compiled
def targets(numbers, after, told, attitude, action, lower, upper, out):
    """``Tick.targets``, and the action kept.

    Args:
        numbers: Of the controller.
        after: (n, STATE_SIZE) the state after this tick; its action is written.
        told: (n, 7) as ``perceive`` left it.
        attitude: (n, 4) as ``perceive`` left it.
        action: (n, 15) within its bounds.
        lower: (15,) bounds of the joints [rad].
        upper: (15,).
        out: (n, 15 or more), written: the targets of legs and waist [rad].
    """
    for world in range(len(after)):
        now = after[world]
        copy(action[world], now[_ACTION:_SLEWED])
        standing = now[_CLOCK + 2] > 0.5
        if numbers.use_reference:
            reference_targets(
                numbers.table, numbers.load, numbers.gait, told[world], now[_CLOCK], now[_CLOCK + 1], standing,
                max(-now[_CLOCK + 2], 0.0), now[_VELOCITY:_ARMS], now[_ARMS:_CARRIED], now[_CARRIED:_TRIM],
                attitude[world], out[world],
            )  # fmt: skip
        else:
            copy(_HOME, out[world, :_LOWER])
        act(action[world], standing, now[_SLEWED + 3 : _CLOCK], lower, upper, out[world])
