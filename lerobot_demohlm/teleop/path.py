"""Waypoints of both palms -> smooth poses at 10 Hz: how a scripted operator moves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.timing import STEP_DT
from lerobot_demohlm.teleop.operator import OperatorPoses, SceneView

WATCHING_GAIN = 0.1  # share of what a palm misses that a watching operator makes up for each tick
MAX_SHIFT_M = 0.03


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """Where both palms should be, and how long to take.

    Attributes:
        T_world_hands: (2, 4, 4).
        duration_s: From the waypoint before [s].
        grippers: 0 open .. 1 closed, both, or left and right; held all the way.
        watched: Whether the operator watches where the palms really are and leads them there, as one does before
            taking hold of something: arms sag.
    """

    T_world_hands: np.ndarray
    duration_s: float
    grippers: float | tuple[float, float] = 0.0
    watched: bool = False


class HandPath:
    """Palms that go from waypoint to waypoint, at rest at each.

    Args:
        start: (2, 4, 4) where the palms are.
        waypoints: Where they go.
        dt: Tick [s].
    """

    def __init__(self, start: np.ndarray, waypoints: Sequence[Waypoint], dt: float = STEP_DT) -> None:
        hands, grippers, watched, before = [], [], [], start
        for waypoint in waypoints:
            ticks = max(1, round(waypoint.duration_s / dt))
            u = np.arange(1, ticks + 1) / ticks
            eased = u * u * u * (10 - 15 * u + 6 * u * u)  # minimum jerk; a power has other bits with AVX-512
            hands.append(poses.interpolate(before, waypoint.T_world_hands, eased[:, None]))
            grippers.append(np.broadcast_to(waypoint.grippers, (ticks, 2)))
            watched.append(np.full(ticks, waypoint.watched))
            before = waypoint.T_world_hands
        self.T_world_hands = np.concatenate(hands)  # (T, 2, 4, 4)
        self.grippers = np.concatenate(grippers)  # (T, 2)
        self.watched = np.concatenate(watched)  # (T,)

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
        self._pending: list[tuple[np.ndarray, np.ndarray, bool]] = []

    def poses(self, view: SceneView) -> OperatorPoses | None:
        """Return the poses of this tick; None after the last phase."""
        if not self._pending:
            if not self._phases:
                return None
            start = view.T_world_hands if self._hands is None else self._hands
            path = HandPath(start, self._phases.pop(0)(view))
            self._pending = list(zip(path.T_world_hands, path.grippers, path.watched, strict=True))
        wanted, grippers, watched = self._pending.pop(0)
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
        return OperatorPoses(T_world_head=None, T_world_hands=asked, grippers=grippers)
