"""A thing is pushed onto a palm: the pushing hand waits for it, and the palm moves aside with it and is level."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.robot import g1
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.handing_over import HandingOver, HandingOverSettings, handed_over
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.generation.tables import Table

TASK = get_task("Handover")
DEMONSTRATION = demonstrations.load(None, TASK)
PAIR = handed_over(DEMONSTRATION, segment(DEMONSTRATION, TASK))
SETTINGS = HandingOverSettings()
WAY = DEMONSTRATION.T_world_objects[:, 0, :3, 3]
PUSH_TICKS = 25  # for which the thing is pushed, at least
TURN = poses.planar(0.3, -0.2, 2.0)  # from the demonstrated scene to this one


class Seen:
    """A world of which the thing and the hands are seen."""

    def __init__(self) -> None:
        self.thing, self.palms = np.eye(4), np.tile(np.eye(4), (2, 1, 1))

    def pose(self, name: str) -> np.ndarray:
        assert name == "cube"
        return self.thing

    def hands(self) -> np.ndarray:
        return self.palms


def round_table(radius: float, T_world_table: np.ndarray) -> Table:
    return Table(T_world_table=T_world_table, half=np.full(2, radius), is_round=True, height=0.75)


def handing_over(radius: float = 0.12) -> tuple[HandingOver, Seen]:
    """Return what moves the hands in a scene turned by ``TURN``, with a table of another radius."""
    assert PAIR is not None
    world, centre = Seen(), poses.from_rotation(np.eye(3), WAY[0])
    tables = round_table(0.12, centre), round_table(radius, TURN @ centre)
    found = HandingOver(world, TASK, DEMONSTRATION, PAIR, tables, SETTINGS)  # pyright: ignore[reportArgumentType]
    found.begin(TURN)
    return found, world


def placed(world: Seen, tick: int, ahead: float = 0.0, left: float = 0.0) -> None:
    """Put the thing where its demonstrated way has it, moved ahead and to the left of the way's direction [m]."""
    pushed = (WAY[PAIR[0].start + 20] - WAY[PAIR[0].start])[:2] if PAIR else np.zeros(2)
    u = np.append(pushed / np.linalg.norm(pushed), 0.0)
    place = WAY[tick] + ahead * u + left * np.array([-u[1], u[0], 0.0])
    world.thing = TURN @ poses.from_rotation(np.eye(3), place)


def test_only_handover_hands_a_thing_over_on_a_palm() -> None:
    found = {}
    for name in all_tasks():
        demonstration = demonstrations.load(None, get_task(name))
        found[name] = handed_over(demonstration, segment(demonstration, get_task(name)))
    pushing = found.pop("Handover")
    assert pushing is not None and [entry.hand for entry in pushing] == ["right", "left"]
    assert set(found.values()) == {None}


def test_a_thing_on_its_way_leaves_the_hands_alone() -> None:
    found, world = handing_over()
    for tick in range(len(DEMONSTRATION)):
        placed(world, tick)
        np.testing.assert_allclose(found.beside(tick), 0.0, atol=1e-9)
        np.testing.assert_allclose(found.held_back(tick), 0.0, atol=1e-9)


def test_the_pushing_hand_waits_for_a_thing_that_is_ahead() -> None:
    """It stays back until the thing is on its way again, and then keeps its distance."""
    found, world = handing_over()
    assert PAIR is not None
    start = PAIR[0].start
    shifts = []
    for tick in range(start, start + 20):
        placed(world, tick, ahead=0.04)
        shifts.append(found.held_back(tick))
    assert (np.diff(np.linalg.norm(shifts, axis=1)) >= 0.0).all()
    assert np.linalg.norm(shifts[-1]) == pytest.approx(SETTINGS.max_back_m)
    ahead = TURN[:3, :3] @ (WAY[start + 20] - WAY[start])
    assert shifts[-1] @ ahead < 0.0 and abs(shifts[-1][2]) < 1e-9
    placed(world, start + 20)
    np.testing.assert_allclose(found.held_back(start + 20), shifts[-1])
    np.testing.assert_allclose(found.held_back(len(DEMONSTRATION) - 1), shifts[-1])


@pytest.mark.parametrize(("left", "moved"), [(0.03, 0.03), (-0.02, -0.02), (0.2, SETTINGS.max_aside_m)])
def test_the_palm_moves_aside_with_the_thing(left: float, moved: float) -> None:
    found, world = handing_over()
    assert PAIR is not None
    placed(world, PAIR[1].stop - 1, ahead=0.05, left=left)
    beside = found.beside(PAIR[1].stop - 1)
    across = poses.transform(poses.invert(TURN), TURN[:3, 3] + beside)
    assert np.linalg.norm(beside) == pytest.approx(abs(moved), abs=1e-3)
    assert across @ np.array([-1.0, 0.0, 0.0]) == pytest.approx(moved, abs=0.004)  # pushed to the left, along y


@pytest.mark.parametrize("radius", [0.10, 0.12, 0.14])
def test_hands_keep_to_the_edge_of_another_table(radius: float) -> None:
    """Further out or in by a share of what the edge is: the palm at once, the pushing hand as it comes there."""
    found, world = handing_over(radius)
    assert PAIR is not None
    further = SETTINGS.edge_share * (radius - 0.12)
    placed(world, 0)
    assert np.linalg.norm(found.beside(0)) == pytest.approx(abs(further), abs=1e-6)
    start = PAIR[0].start
    last = int(np.argmax(WAY[: start + PUSH_TICKS, 1]))  # pushed to the left, along y, as far as it goes
    for tick in range(start, start + PUSH_TICKS):
        gone = np.linalg.norm((WAY[tick] - WAY[start])[:2]) / np.linalg.norm((WAY[last] - WAY[start])[:2])
        placed(world, tick, ahead=further * min(gone, 1.0))
        shift = found.held_back(tick)
    assert np.linalg.norm(shift) == pytest.approx(abs(further), abs=0.002)


def test_the_palm_is_level_before_the_thing_comes() -> None:
    """Fingers that hang by eight degrees come up to what is wanted, and the palm's own direction is kept."""
    found, world = handing_over()
    assert PAIR is not None
    hang = 0.14
    targets = np.tile(np.eye(4), (2, 1, 1))
    targets[found.taker, :3, :3] = poses.rotation_from_rpy([-np.pi / 2, 0.0, 0.7])
    for tick in range(PAIR[1].stop + 10):
        asked = found.levelled(targets, tick)
        fingers = asked[found.taker, :3, 0]
        down = poses.rotation_from_vector(hang * np.array([-fingers[1], fingers[0], 0.0]))
        world.palms[found.taker] = asked[found.taker]
        world.palms[found.taker, :3, :3] = down @ asked[found.taker, :3, :3]
        if tick < PAIR[1].stop - SETTINGS.level_ticks:
            np.testing.assert_array_equal(asked, targets)
    assert world.palms[found.taker, 2, 0] == pytest.approx(-np.sin(SETTINGS.fingers_low_rad), abs=0.01)
    np.testing.assert_array_equal(asked[found.giver], targets[found.giver])
    assert poses.yaw(asked[found.taker]) == pytest.approx(0.7, abs=1e-6)
    assert g1.SIDES[found.taker] == "left"


def test_hands_move_for_it_in_r4_alone() -> None:
    """Elsewhere attempts have the bits that they had."""
    episodes = {}
    for region in ("R3", "R4"):
        for settings in (SETTINGS, HandingOverSettings(max_back_m=0.0, max_forward_m=0.0, max_turn_rad=0.0)):
            varied = Settings(variation=replace(PLAIN, variation="real"), handing_over=settings)
            attempts = Attempts(TASK, DEMONSTRATION, region, 970_003, settings=varied)
            (episode,) = attempts.run([0])
            attempts.close()
            episodes[region, settings] = episode.action.tobytes()
    assert len({actions for (region, _), actions in episodes.items() if region == "R3"}) == 1
    assert len({actions for (region, _), actions in episodes.items() if region == "R4"}) == 2
