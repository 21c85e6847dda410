"""The judge of attempts and rollouts: what counts, for how long, and what an episode comes to."""

import dataclasses

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs.episode import RunningEpisodes
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation, StepResult
from gym_demohlm.simulation.judge import COLLISION_N, COLLISION_STEPS, Judge, held, outcome
from gym_demohlm.timing import HOLD_STEPS, STAND_STEPS, TICKS
from tests.helpers.hold import HoldController

TASK = get_task("LiftBox")
EVERY = np.ones(2, dtype=bool)


def pressing(*forces_n: float) -> StepResult:
    """Return a step in which robots press on an obstacle, each with its force in one of the ticks."""
    collisions = np.zeros((len(forces_n), TICKS))
    collisions[:, 2] = forces_n
    return StepResult(
        commands=np.zeros((len(forces_n), command.SIZE)),
        num_clipped=np.zeros(len(forces_n), dtype=int),
        contact_forces=np.zeros((len(forces_n), TICKS, 2)),
        collision_forces=collisions,
        unstable=np.zeros(len(forces_n), dtype=bool),
    )


@pytest.fixture
def judge() -> Judge:
    return Judge(Simulation(TASK, 2, controller=HoldController(2)))


def test_a_push_collides_once_it_has_lasted(judge: Judge) -> None:
    for _ in range(COLLISION_STEPS - 1):
        judge.watch(pressing(COLLISION_N + 1, COLLISION_N - 1), EVERY)
    assert not judge.collided.any()
    judge.watch(pressing(0.0, 0.0), EVERY)  # it lets go, and begins anew
    for step in range(COLLISION_STEPS):
        assert not judge.collided.any(), step
        judge.watch(pressing(COLLISION_N + 1, COLLISION_N - 1), EVERY)
    assert judge.collided.tolist() == [True, False]
    judge.watch(pressing(0.0, 0.0), EVERY)
    assert judge.faults()["collided"].tolist() == [True, False]  # it is not forgotten
    judge.reset(np.array([0]))
    assert not judge.collided.any()


def test_worlds_that_are_not_stepped_stay_as_they_were(judge: Judge) -> None:
    only_first = np.array([True, False])
    for _ in range(COLLISION_STEPS):
        judge.watch(pressing(100.0, 100.0), only_first)
    assert judge.collided.tolist() == [True, False]


def test_success_must_hold_for_a_second() -> None:
    holds = np.array([True, True])
    sim = Simulation(dataclasses.replace(TASK, success=lambda _: holds.copy()), 2, controller=HoldController(2))
    judge = Judge(sim)
    judge.reset(np.arange(2))
    assert judge.success_ever.all()
    history = []
    for step in range(HOLD_STEPS + 4):
        holds[1] = step != 3
        judge.watch(pressing(0.0, 0.0), EVERY)
        history.append(judge.success_held)
    assert next(step for step, (first, _) in enumerate(history) if first) == HOLD_STEPS - 1
    assert next(step for step, (_, second) in enumerate(history) if second) == HOLD_STEPS + 3
    assert held([False] + [True] * HOLD_STEPS) and not held([True] * (HOLD_STEPS - 1))


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        ({}, "timeout"),
        ({"fell": False, "collided": True, "dropped": True}, "collided"),
        ({"fell": True, "collided": True}, "fell"),
        ({"fell": False, "collided": False, "spilled": True}, "dropped"),
    ],
)
def test_an_outcome_is_the_worst_fault(faults: dict[str, bool], expected: str) -> None:
    assert outcome(False, faults) == expected
    assert outcome(True, faults) == "success"


def test_a_failure_named_like_a_fault_does_not_hide_it() -> None:
    task = dataclasses.replace(TASK, failures={"collided": lambda sim: np.zeros(sim.num_worlds, dtype=bool)})
    judge = Judge(Simulation(task, 2, controller=HoldController(2)))
    for _ in range(COLLISION_STEPS):
        judge.watch(pressing(100.0, 0.0), EVERY)
    assert judge.faults()["collided"].tolist() == [True, False]


def test_a_touch_of_the_table_is_no_collision_in_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """The collision sensors are made to read what a robot that leans on the table would press with."""
    episodes = RunningEpisodes(TASK, controller=HoldController(1))
    original = episodes.sim.step
    for force_n, expected in ((30.0, False), (COLLISION_N + 1, True)):

        def step(commands: np.ndarray, active: np.ndarray, force_n: float = force_n) -> StepResult:
            return dataclasses.replace(original(commands, active), collision_forces=np.full((1, TICKS), force_n))

        monkeypatch.setattr(episodes.sim, "step", step)
        episodes.reset([TASK.default_state()])
        collided = [bool(episodes.step(command.rest()[None]).info["collided"][0]) for _ in range(COLLISION_STEPS)]
        assert collided == [False] * (COLLISION_STEPS - 1) + [expected]
    episodes.close()


def test_a_strict_success_has_no_fault_before_it_and_stands_after_it() -> None:
    """Three robots that stand have succeeded: one is well, one had collided, and one is thrown aside and will fall."""
    sim = Simulation(dataclasses.replace(TASK, success=lambda sim: np.ones(sim.num_worlds, dtype=bool)), 3)
    judge = Judge(sim)
    commands = np.tile(command.rest(), (3, 1))
    for _ in range(HOLD_STEPS):
        judge.watch(sim.step(commands), np.ones(3, dtype=bool))
    judge.faulty[1] = True
    fast = np.array([0.0, 4.0, 1.0, 0.0, 0.0, 0.0])
    sim.set_velocity("pelvis", fast, np.array([2]))
    before = sim.snapshot()
    worlds = np.arange(3)
    assert judge.success_held.all()
    assert judge.strict(worlds).tolist() == [True, False, False]
    assert all(np.array_equal(values, before[name]) for name, values in sim.snapshot().items())
    judge.reset(worlds)
    assert not judge.faulty.any() and not judge.strict(worlds).any()  # not held any more
    sim.close()


def test_what_falls_back_to_where_it_stood_was_dropped() -> None:
    """Boxes in the air, let go: one is to stay there, one may land on the stand, and one is on the stand already.

    None is lower than its start, so only the condition that no longer holds tells of the drop. The last world's
    condition is lost, too, but nothing of it falls.
    """
    lost = np.array([True, False, True])
    condition = np.ones(3, dtype=bool)
    sim = Simulation(dataclasses.replace(TASK, success=lambda _: condition.copy()), 3)
    judge, step = Judge(sim), sim.step
    for _ in range(HOLD_STEPS):
        judge.watch(sim.step(np.tile(command.rest(), (3, 1))), np.ones(3, dtype=bool))
    T_world_box = sim.pose("box")[:2]
    T_world_box[:, 2, 3] += 0.05
    sim.set_pose("box", T_world_box, np.arange(2))

    def step_and_lose(commands: np.ndarray, active: np.ndarray) -> StepResult:
        condition[lost] = False
        return step(commands, active)

    sim.step = step_and_lose  # type: ignore[method-assign]
    assert judge.success_held.all()
    assert judge.strict(np.arange(3)).tolist() == [False, True, True]
    assert not any(np.any(holds) for holds in sim.failures().values())
    sim.close()


def test_the_neck_stays_while_nobody_looks() -> None:
    """The two seconds of the strict judge: what eyes have told last is in a frame that would turn with the neck."""
    sim = Simulation(dataclasses.replace(TASK, success=lambda sim: np.ones(sim.num_worlds, dtype=bool)))
    judge, necks, step = Judge(sim), [], sim.step
    for _ in range(HOLD_STEPS):
        judge.watch(sim.step(command.rest()[None]), np.ones(1, dtype=bool))
    told = sim.p_camera_gaze = np.array([[1.0, 0.2, 0.0]])

    def note(commands: np.ndarray, active: np.ndarray) -> StepResult:
        result = step(commands, active)
        necks.append(sim.neck_positions[0])
        return result

    sim.step = note  # type: ignore[method-assign]
    judge.strict(np.arange(1))
    assert len(necks) == STAND_STEPS and np.ptp(necks, axis=0).max() < 0.03
    assert sim.p_camera_gaze is told
    sim.close()


def test_a_fault_is_not_forgotten(judge: Judge) -> None:
    for _ in range(COLLISION_STEPS):
        judge.watch(pressing(100.0, 0.0), EVERY)
    judge.watch(pressing(0.0, 0.0), EVERY)
    assert judge.faulty.tolist() == [True, False]
