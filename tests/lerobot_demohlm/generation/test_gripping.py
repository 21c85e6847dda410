"""A gripper's hand settles by what it measurably misses, and jaws that close on nothing are found out."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from gym_demohlm.registry import get_task
from lerobot_demohlm.demonstrations.demonstration import Demonstration, load
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.gripping import Gripping
from lerobot_demohlm.generation.stages import GripSettings, StageError

TASK = get_task("GraspCube")
SETTINGS = GripSettings()
RIGHT = 1


@dataclass
class Arms:
    """Stands in for a world: hands that hang below their targets, and jaws that press after a while."""

    targets: np.ndarray
    sag: np.ndarray = field(default_factory=lambda: np.zeros(3))
    forces: list[float] = field(default_factory=list)

    def hands(self) -> np.ndarray:
        measured = self.targets.copy()
        measured[:, :3, 3] += self.sag
        return measured

    def contact_force(self, _side: str, _name: str) -> float:
        return self.forces.pop(0) if self.forces else 0.0


def gripping(arms: Arms) -> tuple[Gripping, Demonstration, int]:
    """Return the grippers of such a world, their demonstration, and when it closes the right one."""
    demonstration = load(None, TASK)
    found = Gripping(arms, TASK, demonstration, segment(demonstration, TASK), SETTINGS)  # type: ignore[arg-type]
    closing = [tick for tick in range(len(demonstration)) if found.closing(tick)]
    assert found.closing(closing[0]) == ["right"]
    return found, demonstration, closing[0]


def settled(sag: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return where the right hand should be and is (3,) in the end, and the ticks that it took."""
    arms = Arms(np.zeros((2, 4, 4)))
    found, demonstration, tick = gripping(arms)
    arms.targets, arms.sag = demonstration.T_world_hands[tick].copy(), sag
    ticks = 0
    for targets in found.settle(tick, arms.targets, lambda _name, _tick: np.eye(4)):
        arms.targets, ticks = targets, ticks + 1
    return demonstration.T_world_hands[tick, RIGHT, :3, 3], arms.hands()[RIGHT, :3, 3], ticks


def test_a_hand_that_is_in_place_does_not_wait() -> None:
    assert settled(np.zeros(3))[2] == 0


def test_a_hand_that_sags_is_raised_until_it_is_in_place() -> None:
    wanted, reached, ticks = settled(np.array([0.0, 0.01, -0.02]))
    assert np.linalg.norm(reached - wanted) < SETTINGS.settle_m
    assert 0 < ticks < SETTINGS.settle_ticks


def test_a_target_is_moved_no_further_than_allowed() -> None:
    wanted, reached, ticks = settled(np.array([0.0, 0.0, -0.1]))
    assert ticks == SETTINGS.settle_ticks
    assert np.linalg.norm(reached - wanted) == pytest.approx(0.1 - SETTINGS.max_correction_m)


def test_jaws_are_waited_for_until_they_press() -> None:
    arms = Arms(np.zeros((2, 4, 4)), forces=[0.0, 0.5, SETTINGS.grip_n])
    found, _, tick = gripping(arms)
    assert len(list(found.verify(tick))) == 2


def test_jaws_that_close_on_nothing_have_missed() -> None:
    found, _, tick = gripping(Arms(np.zeros((2, 4, 4))))
    with pytest.raises(StageError, match=r"the right gripper closed but pressed on the cube with 0\.0 N only") as error:
        list(found.verify(tick))
    assert error.value.outcome == "dropped" and error.value.again
