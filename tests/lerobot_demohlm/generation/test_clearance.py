"""Places and ways are clear of furniture, and stay as they are where they are clear already."""

import math

import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from lerobot_demohlm.demonstrations.demonstration import load
from lerobot_demohlm.demonstrations.segmentation import segment
from lerobot_demohlm.generation.clearance import TOLERANCE_M, stand_clear, way_around
from lerobot_demohlm.generation.locomotion import LocomotionSettings, walk
from lerobot_demohlm.generation.stages import clear_stance, go_around
from lerobot_demohlm.generation.world_view import WorldView
from tests.helpers.hold import HoldController

TABLE = np.array([0.4, 0.1])


def test_the_demonstrated_distance_from_the_table_is_kept() -> None:
    """Of the table under the first object, wherever it is now; the demonstrated place itself stays."""
    for name in ("StackCube", "CarryBox"):
        task, source = get_task(name), load(None, get_task(name))
        sim = Simulation(task, controller=HoldController(1))
        sim.reset([{"robot": [-1.0, 0.0, 0.0], "object": [0.06, -0.1, 0.0]}])
        world = WorldView(sim=sim, index=0, ik=None)  # pyright: ignore[reportArgumentType]  nothing is reached for
        table = sim.pose("table")[0, :2, 3]
        stood = poses.to_planar(source.T_world_pelvis[0]) + np.array([0.0, 0.06, 0.0])  # moved as the table is
        found = clear_stance(stood, world, task, source, segment(source, task))
        np.testing.assert_array_equal(found, stood)
        near = stood + np.array([0.08, 0.0, 0.0])
        moved = clear_stance(near, world, task, source, segment(source, task))
        assert math.dist(moved[:2], table) == pytest.approx(math.dist(stood[:2], table) - TOLERANCE_M)
        sim.close()


@pytest.mark.parametrize("yaw", [-0.7, 0.0, 0.4])
@pytest.mark.parametrize("aside", [-0.15, 0.0, 0.2])
def test_a_place_too_near_a_table_moves_straight_back(yaw: float, aside: float) -> None:
    goal = poses.to_planar(poses.planar(*TABLE, yaw) @ poses.planar(-0.25, aside, 0.0))
    clear = stand_clear(goal, TABLE, 0.42)
    moved = poses.to_planar(poses.invert(poses.planar(*goal)) @ poses.planar(*clear))
    assert math.dist(clear[:2], TABLE) == pytest.approx(0.42)
    assert moved[0] < 0.0 and moved[1:] == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(
    "offset",
    [
        pytest.param((-0.5, 0.0), id="far enough"),
        pytest.param((0.3, 0.0), id="the table is behind"),
        pytest.param((-0.1, 0.45), id="the table is aside"),
    ],
)
def test_a_place_that_is_clear_stays(offset: tuple[float, float]) -> None:
    goal = np.array([*(TABLE + offset), 0.0])
    assert stand_clear(goal, TABLE, 0.42) is goal


def test_a_straight_way_that_is_clear_does_not_bend() -> None:
    assert way_around(np.array([-1.0, 0.6]), np.array([1.0, 0.6]), TABLE, 0.4) is None
    assert way_around(np.array([-1.0, 0.1]), np.array([-0.1, 0.1]), TABLE, 0.4) is None


@pytest.mark.parametrize("seed", range(20))
def test_a_way_that_bends_keeps_clear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = TABLE + rng.uniform(0.5, 1.5) * np.array([math.cos(angle := rng.uniform(-3.1, 3.1)), math.sin(angle)])
    goal = TABLE + 0.42 * np.array([math.cos(turned := angle + rng.uniform(1.6, 2.6)), math.sin(turned)])
    bend = way_around(start, goal, TABLE, 0.38)
    if bend is None:
        legs = [(start, goal)]
    else:
        legs = [(start, bend), (bend, goal)]
    shares = np.linspace(0.0, 1.0, 200)[:, None]
    nearest = min(np.linalg.norm(a + shares * (b - a) - TABLE, axis=1).min() for a, b in legs)
    assert nearest > 0.38 - 1e-6
    mirrored = way_around(goal, start, TABLE, 0.38)
    assert mirrored == pytest.approx(bend) if bend is not None else mirrored is None


class Walker:
    """Stands in for a world: a base that obeys every velocity at once, beside a table."""

    def __init__(self, start: np.ndarray) -> None:
        self.base, self.path = start, [start]

    def pose(self, name: str) -> np.ndarray:
        return poses.planar(*TABLE, 0.0) if name == "table" else poses.planar(*self.base)

    def step(self, velocity: np.ndarray) -> None:
        self.base = poses.to_planar(poses.planar(*self.base) @ poses.planar(*(0.1 * velocity)))
        self.path.append(self.base)


@pytest.mark.parametrize("yaw", [-2.9, -1.8, 2.0, 3.1])
def test_a_robot_walks_around_a_table_to_a_place_behind_it(yaw: float) -> None:
    goal = poses.to_planar(poses.planar(*TABLE, yaw) @ poses.planar(-0.4, 0.0, 0.0))
    walker = Walker(np.array([-0.7, 0.1, 0.0]))
    settings = LocomotionSettings()
    legs = (go_around(walker, get_task("GraspCube"), goal, settings), walk(lambda: walker.pose("pelvis"), goal))  # type: ignore[arg-type]
    for leg in legs:
        for wanted in leg:
            walker.step(wanted[command.VELOCITY])
    path = np.array(walker.path)
    assert math.dist(path[-1, :2], goal[:2]) < settings.accept_m
    assert np.hypot(*(path[:, :2] - TABLE).T).min() > 0.35


def test_nothing_is_walked_around_on_a_clear_way() -> None:
    walker = Walker(np.array([-0.7, 0.1, 0.0]))
    before = poses.to_planar(poses.planar(*TABLE, 0.3) @ poses.planar(-0.4, 0.0, 0.0))
    assert not list(go_around(walker, get_task("GraspCube"), before, LocomotionSettings()))  # type: ignore[arg-type]
    assert not list(go_around(walker, get_task("OpenCabinet"), np.array([1.5, 0, 0]), LocomotionSettings()))  # type: ignore[arg-type]
