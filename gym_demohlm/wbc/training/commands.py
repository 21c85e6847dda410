"""A random generator -> the commands and arm motions that training robots are asked to follow."""

import numpy as np

from gym_demohlm.control import features, gait_clock, reference
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT

_DOWN = np.array([-1.8, -0.1, -0.8, -0.9])  # rad: shoulder pitch, roll, yaw, elbow of the left arm
_UP = np.array([0.6, 1.2, 0.8, 1.5])
_SIGN = np.array([1.0, -1.0, -1.0, 1.0])
_ARM_LOW = np.concatenate([_DOWN, np.minimum(_DOWN * _SIGN, _UP * _SIGN)])
_ARM_HIGH = np.concatenate([_UP, np.maximum(_DOWN * _SIGN, _UP * _SIGN)])
_ARM_HOME = g1.HOME[15:][features.OBSERVED_ARM_INDEX]
_REMEMBERED = 512  # falls whose commands are practised again
_PRACTISED = 0.15  # share of draws that begin such a pair of commands, once the whole range is commanded


class CommandSampler:
    """Commands redrawn every 2-6 s, and arms that move between random poses.

    Falls get rare, and where they happen is a small part of the range: the last commands at which robots fell, each
    with the one before it, are given again more often than chance would have it.

    Attributes:
        goal: (N, 7) drawn commands.
        previous: (N, 7) the ones before.
        arms: (N, 8) arm targets [rad].
    """

    def __init__(self, num_worlds: int, rng: np.random.Generator) -> None:
        self.rng = rng
        self.goal = np.zeros((num_worlds, 7))
        self.previous = np.zeros((num_worlds, 7))
        self.arms = np.tile(_ARM_HOME, (num_worlds, 1))
        self._arm_goal = self.arms.copy()
        self._arm_rate = np.ones((num_worlds, 1))
        self._ticks_left = np.zeros(num_worlds, dtype=int)
        self._next = np.full((num_worlds, 7), np.nan)
        self._hard = np.zeros((0, 2, 7))

    @property
    def arm_goal(self) -> np.ndarray:
        """Where the arms are going, (N, 8) [rad]."""
        return self._arm_goal

    def remember(self, worlds: np.ndarray) -> None:
        """Keep the commands of robots that fell, to practise them."""
        pairs = np.stack([self.previous[worlds], self.goal[worlds]], axis=1)
        self._hard = np.concatenate([self._hard, pairs])[-_REMEMBERED:]

    def reset(self, worlds: np.ndarray, level: float) -> None:
        """Draw new commands for new episodes, which start with the arms where they are sent."""
        self._next[worlds] = np.nan
        self._draw(worlds, level)
        self._draw_arms(worlds, level)
        self.arms[worlds] = self._arm_goal[worlds]

    def start(self, worlds: np.ndarray) -> np.ndarray:
        """Return the slewed commands (n, 7) of episodes that start: at the commanded posture with no velocity."""
        goal = self.goal[worlds]
        goal[:, :3] = 0
        return reference.admissible(goal, goal, np.ones(len(worlds), dtype=bool))

    def advance(self, level: float) -> None:
        """Move on by one control tick."""
        self._ticks_left -= 1
        self._draw(np.nonzero(self._ticks_left <= 0)[0], level)
        self._draw_arms(np.nonzero(self.rng.random(len(self.goal)) < 0.008)[0], level)
        self.arms = self.arms + np.clip(self._arm_goal - self.arms, -self._arm_rate, self._arm_rate)

    def _draw(self, worlds: np.ndarray, level: float) -> None:
        rng, count = self.rng, len(worlds)
        if count == 0:
            return
        stand = rng.random(count) < 0.45
        command = np.zeros((count, 7))
        speed = 0.5 + 0.5 * level
        velocity = speed * np.stack(
            [rng.uniform(-0.55, 0.85, count), rng.uniform(-0.44, 0.44, count), rng.uniform(-1.1, 1.1, count)], axis=1
        )
        velocity[rng.random((count, 3)) < np.array([0.15, 0.3, 0.25])] = 0
        slow = rng.random(count) < 0.25  # the last steps towards a goal are slow
        velocity[slow] *= rng.uniform(0.1, 0.5, (slow.sum(), 1))
        command[:, :3] = velocity
        stand |= (np.abs(velocity) < gait_clock.WALK_THRESHOLD * 1.2).all(axis=1)
        command[stand, :3] = 0
        low = rng.random(count) < 0.75
        squat = np.where(low, rng.uniform(0.74 - 0.35 * level, 0.765, count), 0.74)
        command[:, 3] = np.where(stand, squat, rng.uniform(0.74 - 0.15 * level, 0.765, count))
        bend = rng.uniform(-0.1 - 0.23 * level, 0.15 + 1.08 * level, count)
        command[:, 5] = np.where(stand, bend, rng.uniform(-0.05 - 0.27 * level, 0.1 + 0.32 * level, count))
        reach = stand & (rng.random(count) < 0.15)  # down to the floor: low and bent
        command[reach, 3] = rng.uniform(0.74 - 0.35 * level, 0.74 - 0.15 * level, reach.sum())
        command[reach, 5] = rng.uniform(0.45, 1.22, reach.sum()) * level
        command[rng.random(count) < 0.15, 5] = 0
        command[:, 4] = np.where(stand, rng.uniform(-0.42, 0.42, count) * level, 0)
        yaw = np.where(stand, rng.uniform(-1.04, 1.04, count), rng.uniform(-0.3, 0.3, count))
        command[:, 6] = yaw * level
        command[rng.random(count) < 0.2, 4] = 0
        command[rng.random(count) < 0.2, 6] = 0
        due = ~np.isnan(self._next[worlds, 0])
        command[due] = self._next[worlds[due]]
        self._next[worlds] = np.nan
        if len(self._hard):
            practise = ~due & (rng.random(count) < _PRACTISED * level)
            pairs = self._hard[rng.integers(len(self._hard), size=practise.sum())]
            command[practise], self._next[worlds[practise]] = pairs[:, 0], pairs[:, 1]
        self.previous[worlds] = self.goal[worlds]
        self.goal[worlds] = command
        self._ticks_left[worlds] = rng.integers(100, 300, count)

    def _draw_arms(self, worlds: np.ndarray, level: float) -> None:
        count, reach = len(worlds), 0.3 + 0.7 * level
        random = self.rng.uniform(_ARM_LOW, _ARM_HIGH, (count, len(_ARM_HOME)))
        self._arm_goal[worlds] = _ARM_HOME + reach * (random - _ARM_HOME)
        self._arm_rate[worlds] = self.rng.uniform(0.3, 1.0 + 2.0 * level, (count, 1)) * CONTROL_DT
