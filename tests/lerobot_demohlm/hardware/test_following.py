"""A deployment follows commands tick by tick as a simulation does, and senses what it senses."""

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import CommandError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import CONTROL_DT, TICKS
from lerobot_demohlm.hardware import records, robot_observation
from lerobot_demohlm.hardware.following import SEARCH, SEARCH_SPEED, CommandFollower, NeckFollower, Search


def test_commands_are_those_of_a_simulation() -> None:
    sim, ticks, rng = Simulation(get_task("LiftBox")), [], np.random.default_rng(0)
    sim.on_tick = lambda _worlds, commands: ticks.append(commands[0].copy())
    follower, followed, necks, neck = CommandFollower(command.rest()), [], [], NeckFollower()
    neck._next = sim._neck[0].copy()
    for _ in range(6):
        wanted = command.rest() + rng.normal(scale=0.4, size=command.SIZE)
        target = sim.pose("head_camera")[0], sim.pose(sim.task.gaze_target)[0]
        p_camera = target[0][:3, :3].T @ (target[1][:3, 3] - target[0][:3, 3])
        sim.step(wanted[None])
        follower.take(wanted)
        followed += [follower.tick() for _ in range(TICKS)]
        necks.append([neck.tick(p_camera) for _ in range(TICKS)][-1])
        np.testing.assert_allclose(necks[-1], sim._neck[0], atol=1e-9)
    sim.close()
    np.testing.assert_allclose(followed, ticks, atol=1e-12)


def test_a_late_command_finds_the_arms_where_they_were_sent() -> None:
    follower = CommandFollower(command.rest())
    wanted = command.rest()
    wanted[command.ARMS] += 0.1
    follower.take(wanted)
    last = [follower.tick() for _ in range(3 * TICKS)]
    np.testing.assert_allclose(last[TICKS - 1], wanted)
    np.testing.assert_array_equal(last[-1], last[TICKS - 1])


def test_an_early_command_makes_no_jump() -> None:
    follower = CommandFollower(command.rest())
    wanted = command.rest()
    wanted[command.ARMS] += 0.4
    follower.take(wanted)
    before = [follower.tick() for _ in range(2)][-1]
    follower.take(command.rest())
    assert np.abs(follower.tick() - before)[command.ARMS].max() <= 0.1 + 1e-12


@pytest.mark.parametrize("wanted", [np.full(23, np.nan), np.zeros(22)])
def test_what_is_no_command_is_refused(wanted: np.ndarray) -> None:
    with pytest.raises(CommandError):
        CommandFollower(command.rest()).take(wanted)


@pytest.mark.parametrize("name", ["LiftBox", "GraspCube"])
def test_a_robot_senses_what_a_simulation_does(name: str) -> None:
    sim, rng = Simulation(get_task(name)), np.random.default_rng(1)
    for _ in range(8):
        sim.step((command.rest() + rng.normal(scale=0.2, size=command.SIZE))[None])
    state = records.record(
        "state", q=sim.joint_positions[0], dq=sim.joint_velocities[0], quat_wxyz=sim.base_quat_wxyz[0]
    )
    servos = records.record(
        "servos", neck=sim.neck_positions[0], neck_dq=sim.neck_velocities[0], jaws=sim.gripper_positions[0],
        jaws_dq=sim.gripper_velocities[0],
    )  # fmt: skip
    sensed, expected = robot_observation.agent_pos(state, servos), observation.agent_pos(sim)[0]
    sim.close()
    np.testing.assert_allclose(sensed, expected, atol=2e-6)


def test_a_neck_that_searches_sees_every_direction_and_turns_to_what_it_finds() -> None:
    neck, looked = NeckFollower(), []
    for _ in range(40 * 50):
        looked.append(neck.tick(None, searches=True))
    ways = np.array(looked)
    assert np.abs(np.diff(ways, axis=0)).max() <= SEARCH_SPEED * CONTROL_DT + 1e-9
    for corner in SEARCH:
        assert np.abs(ways - corner).max(axis=1).min() < 0.01
    found = neck.tick(np.array([1.0, 0.5, 0.0]))
    for _ in range(20):
        found = neck.tick(np.array([1.0, 0.5, 0.0]))
    assert found[0] > ways[-1, 0] + 0.3  # it turns left, where the target is


def test_a_neck_that_sees_nothing_and_does_not_search_rests() -> None:
    neck = NeckFollower()
    assert not any(neck.tick(None).any() for _ in range(50))


def test_a_search_goes_on_until_each_object_was_seen_once() -> None:
    """CarryBox's goal; tasks without such objects never search."""
    search = Search(get_task("CarryBox"))
    search.note(np.array([True, False]))
    assert search.goes_on
    search.note(np.array([False, True]))
    assert not search.goes_on
    search.note(np.array([False, False]))
    assert not search.goes_on
    search.begin()
    assert search.goes_on
    assert not Search(get_task("StackCube")).goes_on
