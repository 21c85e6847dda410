"""Commands of a policy at 10 Hz, whenever they come -> the command of each controller tick at 50 Hz.

As ``Simulation.step`` does it: velocity and torso are held, arms go linearly to their new targets over the five ticks
of a step, as far as ``MAX_ARM_SPEED`` takes them. A late command finds them at rest at the last targets.
"""

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.gaze import GazeController
from gym_demohlm.simulation.simulation import MAX_ARM_SPEED
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT, TICKS

SEARCH = np.array(
    [[0.0, 0.55], [1.2, 0.55], [-1.2, 0.55], [-1.2, 0.05], [1.2, 0.05], [1.2, 1.05], [-1.2, 1.05], [0.0, 1.05]]
)
"""(n, 2) yaw and pitch of a neck that searches [rad]: tables first, then the horizon, then the floor."""
SEARCH_SPEED = 0.8  # rad/s


class CommandFollower:
    """What is followed now.

    Args:
        start: (23,) command that the robot obeys already.
    """

    def __init__(self, start: np.ndarray) -> None:
        self._before, self._next = start.copy(), start.copy()
        self._ticks = TICKS

    def take(self, wanted: np.ndarray) -> None:
        """Take in a new command (23,); the next tick is the first of its step.

        Raises:
            CommandError: It is not 23 finite numbers.
        """
        valid = command.clip(command.validate(wanted[None], 1))[0][0]
        reached, way = self.now(), MAX_ARM_SPEED * STEP_DT
        valid[command.ARMS] = np.clip(valid[command.ARMS], reached[command.ARMS] - way, reached[command.ARMS] + way)
        self._before, self._next, self._ticks = reached, valid, 0

    def tick(self) -> np.ndarray:
        """Return the command (23,) of the next tick."""
        self._ticks = min(self._ticks + 1, TICKS)
        return self.now()

    def now(self) -> np.ndarray:
        """Return the command (23,) as far as it is followed."""
        share, found = self._ticks / TICKS, self._next.copy()
        before, after = self._before[command.ARMS], self._next[command.ARMS]
        found[command.ARMS] = (1.0 - share) * before + share * after
        return found


class Search:
    """Tells whether a neck still has to look around, along `SEARCH`, for objects that may be out of view.

    Args:
        task: Whose ``searched`` objects they are.
    """

    def __init__(self, task: Task) -> None:
        names = [entry.name for entry in task.objects]
        self._columns = [names.index(name) for name in task.searched]
        self.begin()

    def begin(self) -> None:
        """Forget what was seen."""
        self._unseen = set(self._columns)

    def note(self, valid: np.ndarray) -> None:
        """Take in which objects (k,) a picture showed."""
        self._unseen -= {column for column in self._unseen if valid[column]}

    @property
    def goes_on(self) -> bool:
        """Whether one of them was never seen."""
        return bool(self._unseen)


class NeckFollower:
    """Turns the neck towards the gaze target, in steps of 0.1 s over five ticks each, as ``Simulation`` does.

    A simulation begins with a neck that looks at the target already. A robot has to find it: while it is not seen, the
    neck looks along ``SEARCH``, again and again.
    """

    def __init__(self) -> None:
        self._gaze = GazeController()
        self._before = self._next = np.zeros(2)
        self._ticks, self._leg = TICKS, 0

    def tick(self, p_camera_target: np.ndarray | None, *, searches: bool = False) -> np.ndarray:
        """Return the angles (2,) of the next tick [rad].

        Args:
            p_camera_target: (3,) where the target was seen in the frame ``head_camera`` [m]; None while it is not.
            searches: Whether to look for a target that is not seen; otherwise the neck rests until it is.
        """
        if self._ticks == TICKS:
            self._before, self._ticks = self._next, 0
            if p_camera_target is not None:
                self._next = self._gaze.step(self._before[None], p_camera_target[None], STEP_DT)[0]
                self._leg = 0
            elif searches:
                self._next = self._search()
        self._ticks += 1
        share = self._ticks / TICKS
        return (1.0 - share) * self._before + share * self._next

    def _search(self) -> np.ndarray:
        """Return the next angles (2,) on the way along ``SEARCH`` [rad]."""
        way = SEARCH[self._leg] - self._before
        step = SEARCH_SPEED * STEP_DT
        if np.abs(way).max() <= step:
            self._leg = (self._leg + 1) % len(SEARCH)
        return self._before + np.clip(way, -step, step)
