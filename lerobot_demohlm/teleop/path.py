"""Waypoints of both palms -> smooth poses at 10 Hz: how a scripted operator moves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView

WATCHING_GAIN = 0.1  # share of what a palm misses that a watching operator makes up for each tick
MAX_SHIFT_M = 0.03
SETTLED_M, SETTLED_TICKS = 0.005, 3  # so near, for so long (0.3 s): what is asked of a palm has settled
MAX_SETTLING_TICKS = 40  # an operator waits no longer for it (4 s)


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """Where both palms should be, and how long to take.

    Attributes:
        T_world_hands: (2, 4, 4).
        duration_s: From the waypoint before [s].
        grippers: 0 open .. 1 closed, both, or left and right; held all the way.
        watched: Whether the operator watches where the palms really are and leads them there, as one does before
            taking hold of something: arms sag.
        settled: Whether the operator sets off only once what is asked of the palms has settled at the waypoint before.
            One who is not shown that, as it is what the operator asked for, need not wait.
    """

    T_world_hands: np.ndarray
    duration_s: float
    grippers: float | tuple[float, float] = 0.0
    watched: bool = False
    settled: bool = False


class HandPath:
    """Palms that go from waypoint to waypoint, at rest at each.

    Args:
        start: (2, 4, 4) where the palms are.
        waypoints: Where they go.
        dt: Tick [s].
    """

    def __init__(self, start: np.ndarray, waypoints: Sequence[Waypoint], dt: float = STEP_DT) -> None:
        hands, grippers, watched, settled, before = [], [], [], [], start
        for waypoint in waypoints:
            ticks = max(1, round(waypoint.duration_s / dt))
            u = np.arange(1, ticks + 1) / ticks
            eased = u * u * u * (10 - 15 * u + 6 * u * u)  # minimum jerk; a power has other bits with AVX-512
            hands.append(poses.interpolate(before, waypoint.T_world_hands, eased[:, None]))
            grippers.append(np.broadcast_to(waypoint.grippers, (ticks, 2)))
            watched.append(np.full(ticks, waypoint.watched))
            settled.append(np.arange(ticks) == (0 if waypoint.settled else -1))
            before = waypoint.T_world_hands
        self.T_world_hands = np.concatenate(hands)  # (T, 2, 4, 4)
        self.grippers = np.concatenate(grippers)  # (T, 2)
        self.watched = np.concatenate(watched)  # (T,)
        self.settled = np.concatenate(settled)  # (T,) before which the operator waits

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.grippers)


Plan = Callable[[SceneView], Sequence[Waypoint]]
"""What an operator sees when a phase begins -> the waypoints of that phase."""


class PathOperator:
    """A scripted operator: phases, each planned when it begins from where things are then.

    Args:
        name: Written into the demonstration.
        phases: Their plans, in order. The hands go on from where the phase before asked them to be.
    """

    def __init__(self, name: str, phases: Sequence[Plan]) -> None:
        self.name = name
        self._phases = list(phases)
        self._hands: np.ndarray | None = None  # where the path has the palms
        self._shift = np.zeros((2, 3))  # m, by which they are asked to go further so that they get there
        self._pending: list[tuple[np.ndarray, np.ndarray, bool, bool]] = []
        self._asked: OperatorPoses | None = None  # the last poses
        self._waited = self._near = 0  # ticks, for what is asked of the palms to settle, and that it has been near

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick; None after the last phase."""
        if not self._pending:
            if not self._phases:
                return None
            start = view.T_world_hands if self._hands is None else self._hands
            path = HandPath(start, self._phases.pop(0)(view))
            self._pending = list(zip(path.T_world_hands, path.grippers, path.watched, path.settled, strict=True))
        wanted, grippers, watched, settled = self._pending[0]
        if settled and self._asked is not None and not self._settled(view, self._asked.T_world_hands):
            return self._asked
        self._pending.pop(0)
        self._waited = self._near = 0
        if watched and self._hands is not None:
            wanted_then = self._hands[:, :3, 3]
            if view.T_world_targets is not None:  # what the palms were asked is late; that is no miss of theirs
                wanted_then = view.T_world_targets[:, :3, 3] - self._shift
            missed = wanted_then - view.T_world_hands[:, :3, 3]
            self._shift = np.clip(self._shift + WATCHING_GAIN * missed, -MAX_SHIFT_M, MAX_SHIFT_M)
        self._hands = wanted
        asked = wanted.copy()
        asked[:, :3, 3] += self._shift
        # No head pose: the script moves hands, and how far to bend follows from them.
        self._asked = OperatorPoses(T_world_head=None, T_world_hands=asked, grippers=grippers)
        return self._asked

    def _settled(self, view: SceneView, asked: np.ndarray) -> bool:
        """Return whether what is asked of the palms, as it is shown, has settled at what was asked for (2, 4, 4)."""
        if view.T_world_targets is None:
            return True
        away = np.linalg.norm((view.T_world_targets - asked)[:, :3, 3], axis=1)
        self._near = self._near + 1 if away.max() <= SETTLED_M else 0
        self._waited += 1
        return self._near >= SETTLED_TICKS or self._waited > MAX_SETTLING_TICKS
