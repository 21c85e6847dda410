"""Waypoints of both palms -> smooth poses at 10 Hz: how a scripted operator moves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """Where both palms should be, and how long to take.

    Attributes:
        T_world_hands: (2, 4, 4).
        duration_s: From the waypoint before [s].
        grippers: 0 open .. 1 closed, both.
    """

    T_world_hands: np.ndarray
    duration_s: float
    grippers: float = 0.0


class HandPath:
    """Palms that go from waypoint to waypoint, at rest at each.

    Args:
        start: (2, 4, 4) where the palms are.
        waypoints: Where they go.
        dt: Tick [s].
    """

    def __init__(self, start: np.ndarray, waypoints: Sequence[Waypoint], dt: float = 0.1) -> None:
        hands, grippers, before = [], [], start
        for waypoint in waypoints:
            ticks = max(1, round(waypoint.duration_s / dt))
            u = np.arange(1, ticks + 1) / ticks
            eased = u**3 * (10 - 15 * u + 6 * u**2)  # minimum jerk
            hands.append(poses.interpolate(before, waypoint.T_world_hands, eased[:, None]))
            grippers.append(np.full((ticks, 2), waypoint.grippers))
            before = waypoint.T_world_hands
        self.T_world_hands = np.concatenate(hands)  # (T, 2, 4, 4)
        self.grippers = np.concatenate(grippers)  # (T, 2)

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.grippers)
