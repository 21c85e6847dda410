"""Handover, ExchangeCube and PourWater: what their success asks for, and water that stays in its vessels."""

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.tasks import handover
from gym_demohlm.tasks.pour_water import BOWL_POSITION, BOWL_RADIUS, DROPS, NUM_DROPS, share_in_bowl
from gym_demohlm.variation import get_variation
from tests.helpers.hold import HoldController


def make(name: str, lowered: float = 0.1) -> Simulation:
    sim = Simulation(get_task(name), controller=HoldController(1))
    sim.reset([{"robot": [-0.6, 0.0, 0.0], "object": [0.05, -lowered, 0.4]}])
    return sim


def put(sim: Simulation, name: str, T_world_body: np.ndarray) -> None:
    """Move a loose body to a pose, at rest."""
    sim.set_pose(name, T_world_body)


@pytest.mark.parametrize("name", ["Handover", "ExchangeCube", "PourWater"])
def test_nothing_succeeds_or_fails_by_itself(name: str) -> None:
    sim = make(name)
    for _ in range(5):
        assert not sim.success()[0]
        assert not any(failed[0] for failed in sim.failures().values())
        sim.step(command.rest()[None])
    for entry in sim.task.objects:
        start, now = sim.start_pose(entry.name)[0], sim.pose(entry.name)[0]
        np.testing.assert_allclose(now[:3], start[:3], atol=2e-3)


def test_a_handed_over_cube_is_in_the_left_hand_and_below_the_table() -> None:
    for lowered, is_below in ((0.0, True), (0.2, False)):
        sim = make("Handover", lowered)
        palm = sim.pose("left_palm")[0]
        put(sim, "cube", poses.pose(palm[:3, 3] + [0.0, 0.0, handover.CUBE_EDGE / 2]))
        assert sim.success()[0] == is_below
    sim = make("Handover", 0.0)
    put(sim, "cube", poses.pose(palm[:3, 3] + [0.0, 0.06, 0.0]))
    assert not sim.success()[0]
    put(sim, "cube", poses.pose([0.35, 0.05, 0.2]))
    assert not sim.success()[0] and sim.failures()["dropped"][0]


def test_an_exchanged_cube_must_be_gripped_by_the_left_hand() -> None:
    """Where the cube is does not suffice."""
    sim = make("ExchangeCube")
    T = sim.pose("cube")[0]
    T[1, 3] += 0.5
    put(sim, "cube", T)
    assert not sim.success()[0]


@pytest.mark.parametrize(("size", "share"), [(0.85, 0.0), (1.0, 1.0)])
def test_water_beside_a_small_bowl_is_not_in_it(size: float, share: float) -> None:
    task = get_task("PourWater")
    sim = Simulation(task, variation=get_variation("hard"))
    sim.reset([{**task.default_state(), "objects.size.bowl": [size]}])
    bowl = sim.pose("bowl")[0]
    for name in DROPS:  # beyond the wall of the small one
        put(sim, name, bowl @ poses.pose([0.95 * BOWL_RADIUS, 0.0, 0.0]))
    assert share_in_bowl(sim)[0] == share


def test_water_stays_in_the_bottle_and_counts_in_the_bowl() -> None:
    sim = make("PourWater")
    for _ in range(10):
        sim.step(command.rest()[None])
    T_bottle_world = poses.invert(sim.pose("bottle")[0])
    inside = np.array([poses.transform(T_bottle_world, sim.pose(name)[0, :3, 3]) for name in DROPS])
    assert (np.hypot(inside[:, 0], inside[:, 1]) < 0.025).all()
    assert (inside[:, 2] > -0.08).all() and (inside[:, 2] < 0.0).all()
    assert share_in_bowl(sim)[0] == 0.0
    bowl = sim.pose("bowl")[0]
    for index, name in enumerate(DROPS[:8]):
        angle = np.pi / 4 * index
        put(sim, name, bowl @ poses.pose([0.03 * np.cos(angle), 0.03 * np.sin(angle), 0.01]))
    for _ in range(10):
        sim.step(command.rest()[None])
    assert share_in_bowl(sim)[0] == pytest.approx(8 / NUM_DROPS)
    assert not sim.success()[0]
    assert np.linalg.norm(sim.pose("bowl")[0, :3, 3] - np.add(BOWL_POSITION, [0.0, 0.05, -0.1])) < 2e-3
