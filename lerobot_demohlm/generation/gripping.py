"""A gripper about to close -> targets that bring its hand to where the demonstrated one was, and a grip that holds.

A hand that is a few millimetres off would push what it should take hold of. So it settles first, by what it measurably
misses; and jaws that have closed must press on their object.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from gym_demohlm.arithmetic import norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segmentation import TOGETHER_TICKS, gripper_events
from lerobot_demohlm.demonstrations.segments import Segment
from lerobot_demohlm.generation.stages import GripSettings, StageError
from lerobot_demohlm.generation.world_view import WorldView


class Gripping:
    """The grippers of one world.

    Args:
        world: The world.
        task: The task.
        demonstration: The source.
        segments: Its segments.
        settings: Limits and times.

    Attributes:
        switches: Ticks at which a gripper closes or opens.
    """

    def __init__(
        self,
        world: WorldView,
        task: Task,
        demonstration: Demonstration,
        segments: Sequence[Segment],
        settings: GripSettings,
    ) -> None:
        self._world, self._task, self._demonstration, self._settings = world, task, demonstration, settings
        self._approaches = [entry for entry in segments if entry.kind == "object" and entry.held is None]
        events = [] if task.hands == "rubber" else gripper_events(demonstration.action)
        self.switches = {event.tick for event in events}
        self._closing: dict[int, list[str]] = {}
        for event in events:
            if event.kind == "close":
                self._closing.setdefault(event.tick, []).append(event.hand)

    def closing(self, tick: int) -> list[str]:
        """Return the sides whose grippers close at a tick."""
        return self._closing.get(tick, [])

    def settle(self, tick: int, planned: np.ndarray, motion: Callable[[str, int], np.ndarray]) -> Iterator[np.ndarray]:
        """Yield targets (2, 4, 4) until hands are beside their objects as they were in the demonstration.

        Args:
            tick: At which grippers close.
            planned: (2, 4, 4) last targets, which are corrected.
            motion: Of an object, by name, from where it was at a tick of the demonstration to where it is; (4, 4).
        """
        wanted: dict[int, np.ndarray] = {}
        for side in self.closing(tick):
            entry = self._approached(tick, side)
            if entry is not None and entry.object is not None:
                hand = g1.SIDES.index(side)
                palm = motion(entry.object, tick) @ self._demonstration.T_world_hands[tick, hand]
                wanted[hand] = palm[:3, 3]
        targets = planned
        for _ in range(self._settings.settle_ticks):
            measured = self._world.hands()
            errors = {hand: position - measured[hand, :3, 3] for hand, position in wanted.items()}
            if all(float(norm(error)) < self._settings.settle_m for error in errors.values()):
                return
            targets = targets.copy()
            for hand, error in errors.items():
                moved = targets[hand, :3, 3] + self._settings.gain * error - planned[hand, :3, 3]
                moved *= min(1.0, self._settings.max_correction_m / max(float(norm(moved)), 1e-9))
                targets[hand, :3, 3] = planned[hand, :3, 3] + moved
            yield targets

    def verify(self, tick: int) -> Iterator[None]:
        """Yield while grippers that closed at a tick do not press on their objects yet.

        Raises:
            StageError: A gripper has closed on nothing.
        """
        pairs = []
        for side in self.closing(tick):
            entry = self._approached(tick, side)
            if entry is not None and (side, entry.object) in self._task.contact_pairs:
                pairs.append((side, str(entry.object)))
        for _ in range(self._settings.grip_ticks):
            if all(self._world.contact_force(*pair) >= self._settings.grip_n for pair in pairs):
                return
            yield
        forces = {pair: self._world.contact_force(*pair) for pair in pairs}
        (side, name), force = min(forces.items(), key=lambda item: item[1])
        raise StageError(
            "dropped",
            f"the {side} gripper closed but pressed on the {name} with {force:.1f} N only (a grip is "
            f"{self._settings.grip_n:g} N): it missed",
            again=tick == min(self._closing),
        )

    def _approached(self, tick: int, side: str) -> Segment | None:
        """Return the segment in which a hand goes to the object that it is about to take hold of at a tick."""
        recent = [
            entry
            for entry in self._approaches
            if entry.hand == side and entry.start < tick and tick - entry.stop <= TOGETHER_TICKS
        ]
        return recent[-1] if recent else None
