"""One tick of a controller: its memory, its sensors and a command -> what its policy sees, and then joint targets.

Training (``wbc.training.mdp``) and running (``control.whole_body``) call these same functions on the same state, so
that a policy runs as it was trained. A tick senses, moves command and clock on, shows the policy the outcome, and turns
the policy's action into targets; whatever it leads to is seen in the next.
"""

from dataclasses import dataclass, fields

import numpy as np

from gym_demohlm.control import attitude, features, gait_clock, odometry, reference, trim, velocity_map
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.settings import Settings
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

LEGS, _LOWER = len(g1.LEG_JOINTS), reference.NUM_LOWER
HISTORY_SIZE = features.HISTORY * features.FRAME_SIZE
LAST_ACTION = slice(HISTORY_SIZE, HISTORY_SIZE + features.ACTION_SIZE)
SLEWED = slice(LAST_ACTION.stop, LAST_ACTION.stop + 7)
CLOCK = SLEWED.stop
STANDING = CLOCK + 2
VELOCITY = slice(CLOCK + 3, CLOCK + 5)
ARMS = slice(VELOCITY.stop, VELOCITY.stop + len(features.OBSERVED_ARM_JOINTS))
CARRIED = slice(ARMS.stop, ARMS.stop + 2)
TRIM = slice(CARRIED.stop, CARRIED.stop + 5)
STATE_SIZE = TRIM.stop
"""Numbers that a controller remembers: history, last action, slewed command, phase, stopped, standing or, below
zero, what is left of the recovery from a push, velocity from the odometry, arm targets, loads, trim."""

REST = np.array([0.0, 0.0, 0.0, g1.PELVIS_HEIGHT, 0.0, 0.0, 0.0])  # of a slewed command
_TRIMMED, _TORSO = slice(2, 7), slice(3, 7)  # of a slewed command
CONSTANT = 0.01  # m/s, m, rad: a command that moves on by less than this in a step is taken for a constant one
WHILE_STANDING = np.array([False, True, True, True, True])  # when an entry is trimmed
LARGEST_ARM_SPEED = 5.0  # rad/s: what arm targets are led by at most


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """What a G1 measures; joints are ``features.OBSERVED_JOINTS``.

    Attributes:
        quat_wxyz: (N, 4) pelvis orientation; only its gravity direction is used.
        gyro: (N, 3) pelvis angular velocity in the pelvis frame [rad/s].
        q: (N, 23) joint positions [rad].
        dq: (N, 23) their velocities [rad/s].
    """

    quat_wxyz: np.ndarray
    gyro: np.ndarray
    q: np.ndarray
    dq: np.ndarray

    @classmethod
    def of(cls, sensed: Proprioception) -> "Sensors":
        """Return what a controller looks at of all that robots sense."""
        seen = features.OBSERVED_INDEX
        return cls(quat_wxyz=sensed.quat_wxyz, gyro=sensed.gyro, q=sensed.q[:, seen], dq=sensed.dq[:, seen])

    def frame(self) -> np.ndarray:
        """Return them as the policy sees them, (N, FRAME_SIZE)."""
        return features.frame(self.quat_wxyz, self.gyro, self.q, self.dq)

    def attitude(self) -> np.ndarray:
        """Return pitch and roll of the pelvis [rad] and their rates [rad/s], (N, 4)."""
        roll, pitch = attitude.roll_pitch(features.gravity(self.quat_wxyz))
        return np.stack([pitch, roll, self.gyro[:, 1], self.gyro[:, 0]], axis=1)


@dataclass(frozen=True, kw_only=True)
class Situation:
    """What a tick finds before its policy acts.

    Attributes:
        history: (N, HISTORY * FRAME_SIZE) frames, oldest first.
        last_action: (N, 15).
        slewed: (N, 7) command.
        told: (N, 7) command with gain and trim: what policy and reference get.
        clock: Of the gait.
        velocity: (N, 2) of the pelvis in its heading frame, from the odometry [m/s].
        arms: (N, 8) arm targets [rad].
        arm_velocity: (N, 8) how fast these move [rad/s].
        carried: (N, 2) what the hands are found to carry [kg].
        trim: (N, 5) the slow correction.
        attitude: (N, 4) pitch and roll of the pelvis [rad], and their rates [rad/s].
        startled: (N,) bool, who loses balance.
    """

    history: np.ndarray
    last_action: np.ndarray
    slewed: np.ndarray
    told: np.ndarray
    clock: gait_clock.Clock
    velocity: np.ndarray
    arms: np.ndarray
    arm_velocity: np.ndarray
    carried: np.ndarray
    trim: np.ndarray
    attitude: np.ndarray
    startled: np.ndarray

    def observation(self) -> np.ndarray:
        """Return what the policy sees, (N, OBSERVATION_SIZE)."""
        return features.observation(
            self.history,
            self.last_action,
            self.arms,
            self.told,
            self.clock.phase,
            self.clock.standing,
            self.velocity,
            self.arm_velocity,
            self.carried,
        )

    def replace_rows(self, rows: np.ndarray, other: "Situation") -> None:
        """Put the rows of another situation (n,) into this one's arrays, in place."""
        for mine, its in zip(self._arrays(), other._arrays(), strict=True):
            mine[rows] = its

    def _arrays(self) -> list[np.ndarray]:
        values = [getattr(self, entry.name) for entry in fields(self)]
        return [array for value in values for array in (value if isinstance(value, tuple) else (value,))]

    def remember(self, action: np.ndarray) -> np.ndarray:
        """Return the state (N, STATE_SIZE) after this tick, in which the policy acted (N, 15)."""
        kept = [
            self.history,
            action,
            self.slewed,
            _remembered(self.clock),
            self.velocity,
            self.arms,
            self.carried,
            self.trim,
        ]
        return np.concatenate(kept, axis=1)


class Tick:
    """The tick of one controller: what is the same for all worlds and ticks.

    Args:
        pose: The reference that the policy corrects.
        settings: Slew, gain and trim; the gait is the reference's own.
    """

    def __init__(self, pose: reference.Reference, settings: Settings) -> None:
        self.reference, self.settings = pose, settings
        ranges = g1.joint_ranges(g1.read_mjcf())[:_LOWER]
        self._lower, self._upper = ranges[:, 0], ranges[:, 1]
        self._further = np.array(settings.gain) - 1.0
        self._map = velocity_map.coefficients(settings.velocity_map)

    def start(self, sensors: Sensors, slewed: np.ndarray, clock: gait_clock.Clock, arms: np.ndarray) -> np.ndarray:
        """Return the state (N, STATE_SIZE) of controllers that begin.

        Args:
            sensors: Now, and taken for the past too.
            slewed: (N, 7) the command that the robots follow already.
            clock: Of the gait.
            arms: (N, 8) where the arms are sent [rad].
        """
        state = np.zeros((len(slewed), STATE_SIZE))
        state[:, :HISTORY_SIZE] = np.tile(sensors.frame(), (1, features.HISTORY))
        state[:, SLEWED] = slewed
        state[:, CLOCK : VELOCITY.start] = _remembered(clock)
        state[:, ARMS] = arms
        return state

    def perceive(self, state: np.ndarray, sensors: Sensors, commands: np.ndarray, arms: np.ndarray) -> Situation:
        """Sense, and move command, clock and estimates on by 0.02 s.

        Args:
            state: (N, STATE_SIZE) after the tick before.
            sensors: Now.
            commands: (N, 7 or more) velocity and torso within their bounds; slewed here.
            arms: (N, 8) targets of the arms' joints but the wrists' [rad].
        """
        q, dq, gyro = sensors.q, sensors.dq, sensors.gyro
        history = np.concatenate([state[:, features.FRAME_SIZE : HISTORY_SIZE], sensors.frame()], axis=1)
        current, stood = state[:, SLEWED], state[:, STANDING] > 0.5
        goal = reference.admissible(commands, current, stood)
        slewed = reference.slew(current, goal, self.settings.slew)
        down = features.gravity(sensors.quat_wxyz)
        found = odometry.estimate(down, gyro, q[:, :LEGS], dq[:, :LEGS])
        velocity = odometry.smooth(state[:, VELOCITY], found.velocity)
        waist = q[:, LEGS:_LOWER]
        down_torso = attitude.in_torso(down, waist)
        before = state[:, ARMS]
        carried = self.reference.arm_load.weigh(
            state[:, CARRIED], before, q[:, _LOWER:], dq[:, _LOWER:], down_torso, CONTROL_DT
        )
        startled = self._startled(current, before, carried, found, velocity)
        gait, recovers = self.reference.gait, np.maximum(-state[:, STANDING], 0.0)
        clock = gait_clock.Clock(state[:, CLOCK], state[:, CLOCK + 1], stood, recovers)
        pushed = gait_clock.pushed(velocity, slewed, gait)
        clock = gait_clock.advance_clock(clock, slewed[:, :3], startled, pushed, gait)
        turning = -(down * gyro).sum(axis=1)
        measured = np.stack([turning, found.height, *attitude.roll_pitch(down_torso), waist[:, 0]], axis=1)
        constant = (np.abs(goal - current) < CONSTANT).all(axis=1, keepdims=True)
        learns = constant & (clock.standing[:, None] == WHILE_STANDING)
        correction = trim.advance(state[:, TRIM], slewed[:, _TRIMMED], measured, learns, self.settings.trim)
        told = slewed + self._further * (slewed - REST)
        added = velocity_map.further(self._map, slewed)
        told[:, : added.shape[1]] += added
        torso, torso_height = told[:, _TORSO], slewed[:, _TORSO.start]
        trimmed = reference.balanced(torso + correction[:, 1:], torso_height)
        correction[:, 1:] = trimmed - reference.balanced(torso, torso_height)
        told[:, _TRIMMED] += correction
        arm_velocity = np.clip((arms - before) / CONTROL_DT, -LARGEST_ARM_SPEED, LARGEST_ARM_SPEED)
        return Situation(
            history=history,
            last_action=state[:, LAST_ACTION],
            slewed=slewed,
            told=told,
            clock=clock,
            velocity=velocity,
            arms=arms,
            arm_velocity=arm_velocity,
            carried=carried,
            trim=correction,
            attitude=sensors.attitude(),
            startled=startled,
        )

    def targets(self, situation: Situation, action: np.ndarray) -> np.ndarray:
        """Return the joint targets of legs and waist (N, 15) [rad] of an action (N, 15) within its bounds."""
        now = situation
        lower = self.reference(now.told, now.clock, now.velocity, now.arms, now.carried, now.attitude)
        lower += action * reference.action_scale(now.clock.standing, now.slewed[:, _TORSO])
        return np.clip(lower, self._lower, self._upper)

    def _startled(
        self,
        command: np.ndarray,
        arms: np.ndarray,
        carried: np.ndarray,
        found: odometry.Estimate,
        velocity: np.ndarray,
    ) -> np.ndarray:
        """Return who must step to keep upright, (N,) bool, by the command and the arms of the tick before."""
        margins = self.reference.gait.capture
        if margins is None:
            return gait_clock.startled(velocity, found.sole_tilt)
        moment = self.reference.arms_moment(command, arms, carried)
        capture = self.reference.capture(command, moment, found.over_soles, velocity)
        return gait_clock.escapes(capture, margins, found.sole_tilt)


def _remembered(clock: gait_clock.Clock) -> np.ndarray:
    """Return a clock as the state holds it, (N, 3)."""
    return np.stack([clock.phase, clock.stopped, np.where(clock.standing, 1.0, 0.0 - clock.recovers)], axis=1)
