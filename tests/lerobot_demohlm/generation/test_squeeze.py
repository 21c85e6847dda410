"""Two palms press on what they hold as hard as it takes, and let go as the demonstration does."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from gym_demohlm.registry import all_tasks, get_task
from lerobot_demohlm.demonstrations.demonstration import load
from lerobot_demohlm.generation.squeeze import Squeeze

STIFFNESS = 800.0  # N/m, of a palm on a box
DEMONSTRATED_N = 15.0


@dataclass
class Palms:
    """Stands in for a world: palms that press on a box as far as they are told to be inside it."""

    half_width: float
    told: np.ndarray = field(default_factory=lambda: np.zeros((2, 4, 4)))

    def contact_force(self, _side: str, _name: str) -> float:
        inside = self.half_width - abs(float(self.told[0, 1, 3] - self.told[1, 1, 3])) / 2
        return max(0.0, STIFFNESS * inside)


def pressed(half_width: float, share: float, ticks: int = 30) -> tuple[Palms, Squeeze, np.ndarray]:
    """Return palms after they were told for some ticks to be 0.24 m apart, what told them, and what was asked."""
    task = get_task("LiftBox")
    palms, asked = Palms(half_width), np.tile(np.eye(4), (2, 1, 1))
    asked[:, 1, 3] = 0.11, -0.11
    squeeze = Squeeze(palms, task, load(None, task), share, 0.04)  # type: ignore[arg-type]
    palms.told = asked
    for _ in range(ticks):
        palms.told = squeeze.tighten(asked, 60)
    return palms, squeeze, asked


@pytest.mark.parametrize("half_width", [0.12, 0.13])
def test_palms_press_as_hard_on_a_smaller_box(half_width: float) -> None:
    palms, _, asked = pressed(half_width, 2.0)
    assert palms.contact_force("left", "box") == pytest.approx(2.0 * DEMONSTRATED_N, rel=0.1)
    assert palms.told[:, [0, 2], 3] == pytest.approx(asked[:, [0, 2], 3])
    assert palms.told.mean(axis=0) == pytest.approx(asked.mean(axis=0))


def test_targets_are_moved_no_further_than_allowed_and_never_apart() -> None:
    assert pressed(0.05, 2.0)[0].told[0, 1, 3] == pytest.approx(0.11 - 0.04)
    assert pressed(0.20, 2.0)[0].told[0, 1, 3] == pytest.approx(0.11)


def test_without_a_share_targets_are_the_demonstrated_ones() -> None:
    palms, _, asked = pressed(0.12, 0.0)
    assert palms.told is asked


def test_palms_open_once_the_demonstration_has_let_go() -> None:
    _, squeeze, asked = pressed(0.12, 2.0)
    for _ in range(5):
        told = squeeze.tighten(asked, 0)  # a tick at which the demonstrated palms are free
    assert told == pytest.approx(asked)


def test_only_what_is_held_between_the_palms_is_squeezed() -> None:
    """A cart is pushed and a door pulled: no palm presses against the other."""
    squeezed = set()
    for name in all_tasks():
        task = get_task(name)
        palms, asked = Palms(0.0), np.tile(np.eye(4), (2, 1, 1))
        asked[:, 1, 3] = 0.2, -0.2
        source = load(None, task)
        squeeze = Squeeze(palms, task, source, 2.0, 0.04)  # type: ignore[arg-type]
        moved = [squeeze.tighten(asked, tick)[0, 1, 3] < 0.19 for tick in range(len(source))]
        squeezed |= {name} if any(moved) else set()
    assert squeezed == {"LiftBox", "CarryBox"}
