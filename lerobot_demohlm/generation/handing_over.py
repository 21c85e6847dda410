"""A thing that one hand pushes off a table onto the other hand's palm -> how both hands' targets move for its way.

In worlds that vary, a can may lie between the pushing hand and the thing or stand in its way, the table may be wider,
and a palm hangs with its fingers down. Hands that only repeated their own way would push the thing too far, or beside
the palm, or it would slide off. What is to be repeated is the way of the thing; so the pushing hand waits where the
thing is ahead of it, and the palm moves aside with the thing, stays beside the edge, and is level.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import dot, norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation.tables import Table
from lerobot_demohlm.generation.world_view import WorldView

_FACING = {"left": -1.0, "right": 1.0}  # where a palm faces, along its own y
_UPWARD = 0.9  # least cosine of the angle between where a palm faces and the vertical at which it faces up


@dataclass(frozen=True, kw_only=True)
class HandingOverSettings:
    """How hands keep to the way of a thing that one pushes onto the other, in R4 of worlds that vary.

    Attributes:
        gain: Share of the distance by which the thing is too far ahead that the pushing hand moves back in each tick.
        max_back_m: Largest distance by which that hand stays back [m].
        max_forward_m: Largest distance by which it goes further for a thing that lags behind [m].
        max_aside_m: Largest distance by which the palm moves aside with the thing [m].
        edge_share: Share of the distance by which the edge is too far away that both hands go further.
        level_gain: Share of the angle by which the fingers are too low that the palm turns by in each tick.
        level_ticks: Ticks before the thing comes onto the palm in which it turns; then it keeps its turn.
        fingers_low_rad: Angle by which the fingers are to be lower than the wrist [rad].
        max_turn_rad: Largest angle by which the palm turns [rad].
    """

    gain: float = 0.2
    max_back_m: float = 0.08
    max_forward_m: float = 0.02
    max_aside_m: float = 0.05
    edge_share: float = 0.5
    level_gain: float = 0.15
    level_ticks: int = 25
    fingers_low_rad: float = 0.05
    max_turn_rad: float = 0.35


class HandingOver:
    """The hands of one world between which a thing is handed over.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        pair: The segments of the hand that pushes and of the palm that takes, from ``handed_over``.
        tables: The demonstrated table and the one here.
        settings: Gains and limits.

    Attributes:
        giver: The hand that pushes, by number.
        taker: The hand that takes.
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        pair: tuple[Segment, Segment],
        tables: tuple[Table, Table],
        settings: HandingOverSettings,
    ) -> None:
        push, take = pair
        self._world, self._tables, self._settings = world, tables, settings
        self.giver, self.taker = (g1.SIDES.index(entry.hand) for entry in pair)
        self._name, self._start, self._taken = str(push.object), push.start, take.stop
        column = task.contact_pairs.index((push.hand, self._name))
        self._stop = int(np.flatnonzero(demonstration.contact_forces[:, column] >= CONTACT_FORCE_N)[-1]) + 1
        names = [entry.name for entry in task.objects]
        self._way = demonstration.T_world_objects[:, names.index(self._name), :3, 3]
        pushed = self._way[self._stop - 1, :2] - self._way[self._start, :2]
        self._length = float(norm(pushed))
        self._ahead_then = np.append(pushed / self._length, 0.0)
        self._motion, self._ahead, self._further = np.eye(4), self._ahead_then, 0.0
        self._back, self._shift = 0.0, np.zeros(3)
        self._lift = 0.0  # rad, by which the fingers are turned up

    def begin(self, motion: np.ndarray) -> None:
        """Note the motion (4, 4) that takes the demonstrated thing to this one, as the palm sets out for it."""
        then, now = self._tables
        self._motion, self._ahead = motion, motion[:3, :3] @ self._ahead_then
        here = poses.transform(motion, self._way[0])
        edges = now.way_to_edge(here, self._ahead), then.way_to_edge(self._way[0], self._ahead_then)
        self._further = self._settings.edge_share * (edges[0] - edges[1])

    def beside(self, tick: int) -> np.ndarray:
        """Return how far (3,) from its demonstrated place the palm is to be in a tick in which it waits [m]."""
        across = np.array([-self._ahead[1], self._ahead[0], 0.0])
        limit = self._settings.max_aside_m
        aside = min(max(float(dot(self._off(tick), across)), -limit), limit)
        return aside * across + self._further * self._ahead

    def held_back(self, tick: int) -> np.ndarray:
        """Return how far (3,) from its demonstrated way the pushing hand is to be in a tick [m]; call it in each."""
        if self._start <= tick < self._stop:
            gone = float(dot(self._way[tick] - self._way[self._start], self._ahead_then)) / self._length
            further = min(max(gone, 0.0), 1.0) * self._further
            early = float(dot(self._off(tick), self._ahead)) - further
            back = self._back - self._settings.gain * early
            self._back = min(max(back, -self._settings.max_back_m), self._settings.max_forward_m)
            self._shift = (self._back + further) * self._ahead
        return self._shift

    def levelled(self, targets: np.ndarray, tick: int) -> np.ndarray:
        """Return targets (2, 4, 4) of a tick of which the palm's is turned, so that its fingers do not hang."""
        if tick < self._taken - self._settings.level_ticks:
            return targets
        if tick < self._taken:
            sine = float(self._world.hands()[self.taker, 2, 0])  # near enough to the angle
            low = -sine - self._settings.fingers_low_rad
            lift = self._lift + self._settings.level_gain * low
            self._lift = min(max(lift, -self._settings.max_turn_rad), self._settings.max_turn_rad)
        fingers = targets[self.taker, :2, 0]
        axis = np.array([fingers[1], -fingers[0], 0.0]) / max(float(norm(fingers)), 1e-9)
        result = targets.copy()
        result[self.taker, :3, :3] = poses.rotation_from_vector(self._lift * axis) @ targets[self.taker, :3, :3]
        return result

    def _off(self, tick: int) -> np.ndarray:
        """Return how far (3,) the thing is from where its demonstrated way has it by now [m]."""
        return self._world.pose(self._name)[:3, 3] - poses.transform(self._motion, self._way[tick])


def handed_over(demonstration: Demonstration, segments: Sequence[Segment]) -> tuple[Segment, Segment] | None:
    """Return the segments in which a hand pushes a thing and the other waits for it, palm up; None without such."""
    for push in segments:
        for take in segments:
            if (push.kind, take.kind) != ("proprioception", "object") or push.object != take.object:
                continue
            hand = g1.SIDES.index(take.hand)
            facing = _FACING[take.hand] * demonstration.T_world_hands[take.stop - 1, hand, 2, 1]
            if push.hand != take.hand and take.start < push.start < take.stop and facing > _UPWARD:
                return push, take
    return None
