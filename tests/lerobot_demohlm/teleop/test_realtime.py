"""The wall clock adds nothing to a step but time."""

from collections.abc import Callable

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT, TICKS
from lerobot_demohlm.teleop.realtime import RealTimeWorld, body_poses


class FakeClock:
    """A clock that goes on when somebody sleeps, and by ``cost`` at every look."""

    def __init__(self, cost: float = 0.0) -> None:
        self.now, self.cost = 0.0, cost
        self.slept: list[float] = []

    def __call__(self) -> float:
        self.now += self.cost
        return self.now

    def sleep(self, time_s: float) -> None:
        self.slept.append(time_s)
        self.now += time_s


def test_the_same_bits_as_plain_steps() -> None:
    task = get_task("LiftBox")
    plain, ticked = Simulation(task), Simulation(task)
    world = RealTimeWorld(ticked, *_fake(FakeClock()))
    wanted = command.rest()
    wanted[0], wanted[command.HEIGHT] = 0.3, 0.7
    for _ in range(5):
        plain.step(wanted[None])
        world.wait()
        world.step(wanted)
        body_poses(ticked)
    after, expected = ticked.snapshot(), plain.snapshot()
    assert all(after[name].tobytes() == expected[name].tobytes() for name in expected)


def test_ticks_are_begun_when_they_are_due() -> None:
    sim, clock = Simulation(get_task("LiftBox")), FakeClock()
    world = RealTimeWorld(sim, *_fake(clock))
    begun: list[float] = []
    numbers: list[int] = []
    world.after_tick = lambda tick: (begun.append(clock.now), numbers.append(tick))
    for _ in range(3):
        world.wait()
        world.step(command.rest())
    np.testing.assert_allclose(begun, 0.02 * np.arange(3 * TICKS), atol=1e-9)
    assert numbers == [*range(TICKS)] * 3
    assert world.factor == 1.0
    assert world.late_s == 0.0


def test_a_slow_machine_is_late_and_says_so() -> None:
    sim, clock = Simulation(get_task("LiftBox")), FakeClock(cost=0.06)
    world = RealTimeWorld(sim, *_fake(clock))
    for _ in range(6):
        world.wait()
        world.step(command.rest())
    assert world.factor < 0.6
    assert world.late_s > STEP_DT


def test_body_poses_are_those_of_the_simulation() -> None:
    sim = Simulation(get_task("GraspCube"))
    sim.step(command.rest()[None])
    shown = body_poses(sim)
    cube = sim.model.body("cube").id
    np.testing.assert_allclose(shown[cube, :3], sim.pose("cube")[0, :3, 3], atol=1e-6)


def _fake(clock: FakeClock) -> tuple[FakeClock, Callable[[float], None]]:
    return clock, clock.sleep
