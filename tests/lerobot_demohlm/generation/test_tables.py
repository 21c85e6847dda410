"""Robots keep clear of tables that are higher, wider or turned: where they stand, and how hands come over them."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.variation import get_variation
from lerobot_demohlm.datasets.variation import PLAIN
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.attempt import Attempts
from lerobot_demohlm.generation.clearance import TOLERANCE_M
from lerobot_demohlm.generation.stages import Settings, first_approach
from lerobot_demohlm.generation.tables import Table, TableSettings, kept_above, risen, stand_off, tables_under
from lerobot_demohlm.generation.world_view import WorldView
from tests.helpers.hold import HoldController

WIDTH = 0.18
SETTINGS = TableSettings()
SQUARE = Table(T_world_table=np.eye(4), half=np.array([0.3, 0.4]), is_round=False, height=0.75)
ROUND = Table(T_world_table=np.eye(4), half=np.array([0.3, 0.3]), is_round=True, height=0.75)
WITH_TABLES = [name for name in all_tasks() if get_task(name).supports]


@pytest.mark.parametrize(
    ("table", "base", "gap"),
    [
        pytest.param(SQUARE, (-0.8, 0.0, 0.0), 0.5, id="before an edge"),
        pytest.param(SQUARE, (-0.8, 0.4, 0.0), 0.5, id="before a corner, one side still before the edge"),
        pytest.param(SQUARE, (-0.6, 0.98, 0.0), 0.5, id="aside: the nearer side is 0.3 m from it and 0.4 m aside"),
        pytest.param(SQUARE, (0.0, 0.0, 1.0), 0.0, id="in it"),
        pytest.param(ROUND, (-0.8, 0.0, 0.0), 0.5, id="before a round one"),
        pytest.param(ROUND, (-0.4, 0.48, 0.0), 0.2, id="beside a round one: the nearer side is 0.5 m from its middle"),
    ],
)
def test_the_gap_is_from_the_nearer_side_to_the_edge(
    table: Table, base: tuple[float, float, float], gap: float
) -> None:
    assert table.gap(np.array(base), WIDTH) == pytest.approx(gap)


@pytest.mark.parametrize("table", [SQUARE, ROUND])
def test_the_gap_stays_when_robot_and_table_move_as_one(table: Table) -> None:
    motion, base = poses.planar(1.2, -0.7, 0.9), np.array([-0.7, 0.2, 0.3])
    moved = replace(table, T_world_table=motion @ table.T_world_table)
    together = poses.to_planar(motion @ poses.planar(*base))
    assert moved.gap(together, WIDTH) == pytest.approx(table.gap(base, WIDTH))


@pytest.mark.parametrize("turn", [0.0, 0.5, 0.9])
def test_a_place_moves_straight_back_until_it_is_as_far_from_the_edge(turn: float) -> None:
    """A turned table has a corner where the demonstrated one had an edge."""
    stood = np.array([-0.45, 0.0, 0.0])
    turned = replace(SQUARE, T_world_table=poses.planar(0.0, 0.0, turn))
    found = stand_off(stood, stood, (SQUARE, turned), SETTINGS)
    least = SQUARE.gap(stood, WIDTH) - TOLERANCE_M
    assert turned.gap(found, WIDTH) >= least and found[1:] == pytest.approx(stood[1:])
    assert (found[0] < stood[0]) == (turned.gap(stood, WIDTH) < least)
    if turn == 0.0:
        np.testing.assert_array_equal(found, stood)


def test_a_place_moves_no_further_back_than_it_may() -> None:
    large = replace(SQUARE, half=np.array([2.0, 2.0]))
    stood = np.array([-0.45, 0.0, 0.0])
    assert stand_off(stood, stood, (SQUARE, large), SETTINGS)[0] == pytest.approx(-0.45 - SETTINGS.most_back_m)


def test_hands_that_hang_low_rise_and_others_stay() -> None:
    palms = np.stack([poses.pose([0.1, 0.2, 0.6]), poses.pose([0.2, -0.1, 0.9])])
    found = risen(palms, [0, 1], 0.8, np.array([-0.05, 0.0]))
    np.testing.assert_allclose(found[0, :3, 3], [0.05, 0.2, 0.8])
    np.testing.assert_array_equal(found[1], palms[1])
    np.testing.assert_array_equal(risen(palms, [1], 0.8, np.zeros(2)), palms)


@pytest.mark.parametrize("height", [0.5, 0.8, 2.0])
def test_a_way_begins_no_lower_than_it_goes_on(height: float) -> None:
    heights = np.array([0.6, 0.7, 0.85, 0.9, 0.7, 0.65])
    path = poses.pose(np.stack([np.linspace(0, 1, 6), np.zeros(6), heights], axis=1), np.tile([1.0, 0, 0, 0], (6, 1)))
    found, enough = kept_above(path, height), min(height, 0.9)
    first = int(np.argmax(heights >= enough))
    assert (found[: first + 1, 2, 3] >= enough).all()
    np.testing.assert_array_equal(found[first:], path[first:])
    np.testing.assert_array_equal(found[:, :2], path[:, :2])


@pytest.mark.parametrize("name", WITH_TABLES)
def test_a_table_is_found_as_demonstrated_and_as_it_stands(name: str) -> None:
    """Raised and widened, under the object that the demonstration goes to first."""
    task = get_task(name).at("R4")
    demonstration = demonstrations.load(None, get_task(name))
    sim = Simulation(task, controller=HoldController(1), variation=get_variation("real:scene"))
    start = {"robot": [-1.0, 0.0, 0.0], "object": [0.03, 0.05, 0.0], "object_x": [0.02]}
    start |= {"scene.table_width": [1.1], "scene.height": [0.02]}
    sim.reset([start])
    world = WorldView(sim=sim, index=0, ik=None)  # pyright: ignore[reportArgumentType]  nothing is reached for
    first = first_approach(segment(demonstration, task, task.is_scattered("R4")))
    found = tables_under(world, task, demonstration, first)
    assert found is not None and first.object is not None
    then, now = found
    np.testing.assert_allclose(now.half, 1.1 * then.half, rtol=1e-6)
    bottom = world.pose(first.object)[2, 3] - demonstration.T_world_objects[0, task_index(name, first.object), 2, 3]
    assert now.height - then.height == pytest.approx(bottom, abs=0.01)
    assert now.gap(poses.to_planar(world.pose(first.object)), 0.0) <= 0.0
    sim.close()


def task_index(name: str, entry: str) -> int:
    return [found.name for found in get_task(name).objects].index(entry)


@pytest.mark.parametrize(
    ("table", "point", "ahead", "way"),
    [
        pytest.param(SQUARE, (0.1, 0.0), (1.0, 0.0), 0.2, id="to the edge ahead"),
        pytest.param(SQUARE, (0.1, 0.1), (0.0, -1.0), 0.5, id="to the edge on the right"),
        pytest.param(SQUARE, (0.0, 0.0), (0.6, 0.8), 0.5, id="aslant, to the nearer edge: both are 0.5 m away"),
        pytest.param(ROUND, (0.0, 0.0), (0.6, 0.8), 0.3, id="from the middle of a round one"),
        pytest.param(ROUND, (0.18, 0.0), (0.0, 1.0), 0.24, id="across a round one"),
    ],
)
def test_the_way_to_the_edge_is_measured_in_its_direction(
    table: Table, point: tuple[float, float], ahead: tuple[float, float], way: float
) -> None:
    """However the table stands."""
    for T in (np.eye(4), poses.planar(1.0, -2.0, 0.7)):
        moved = replace(table, T_world_table=T)
        p_world, direction = poses.transform(T, np.array([*point, 0.9])), T[:3, :3] @ np.array([*ahead, 0.0])
        assert moved.way_to_edge(p_world, direction) == pytest.approx(way)


@pytest.mark.parametrize("name", [name for name in all_tasks() if name not in WITH_TABLES])
def test_what_stands_on_no_table_has_none(name: str) -> None:
    task = get_task(name)
    demonstration = demonstrations.load(None, task)
    sim = Simulation(task, controller=HoldController(1))
    sim.reset([task.default_state()])
    world = WorldView(sim=sim, index=0, ik=None)  # pyright: ignore[reportArgumentType]
    assert tables_under(world, task, demonstration, first_approach(segment(demonstration, task))) is None
    sim.close()


def test_hands_do_not_come_up_under_a_high_table() -> None:
    """The same start fails where robot and hands do as demonstrated: a gripper presses on the table's edge."""
    task = get_task("PourWater")
    outcomes = []
    for tables in (SETTINGS, TableSettings(clear_m=-1.0, most_back_m=0.0)):
        settings = Settings(variation=replace(PLAIN, variation="real"), tables=tables)
        attempts = Attempts(task, demonstrations.load(None, task), "R4", 970_001, settings=settings)
        (episode,) = attempts.run([3])
        attempts.close()
        outcomes.append((episode.outcome, episode.stage))
    assert outcomes == [("success", "manipulation"), ("collided", "pre_manipulation")]
