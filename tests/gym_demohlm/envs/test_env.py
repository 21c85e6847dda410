"""Environments: Gymnasium's contract, LeRobot's contract, and N worlds in one process equal to N single ones."""

import dataclasses
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import gym_demohlm  # noqa: F401  registers the environments
from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.envs.env import DemoHLMEnv
from gym_demohlm.envs.observation import STATE_NAMES, environment_names
from gym_demohlm.envs.vector_env import DemoHLMVectorEnv
from gym_demohlm.errors import CommandError, SceneError, UnknownNameError
from gym_demohlm.registry import all_tasks, get_task
from gym_demohlm.task import Task
from gym_demohlm.timing import HOLD_STEPS
from tests.helpers.hold import HoldController

TASKS = sorted(all_tasks())
FLAGS = ("is_success", "success", "success_ever", "success_held", "fell", "unstable", "collided")


def make(**kwargs: Any) -> DemoHLMEnv:
    return DemoHLMEnv(controller=HoldController(1), **kwargs)


def make_vector(num_envs: int, **kwargs: Any) -> DemoHLMVectorEnv:
    return DemoHLMVectorEnv(num_envs, controller=HoldController(num_envs), **kwargs)


def actions_for(step: int, num_envs: int) -> np.ndarray:
    rng = np.random.default_rng(step)
    spread = rng.uniform(-0.3, 0.3, (num_envs, command.SIZE)) * (np.arange(command.SIZE) > 2)
    return np.clip(command.rest() + spread, command.LOWER, command.UPPER).astype(np.float32)


def assert_same(first: Any, second: Any) -> None:
    """Compare nested observations bit for bit."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    else:
        np.testing.assert_array_equal(first, second)


def shortened(task: Task, steps: int) -> Task:
    return dataclasses.replace(task, episode_length_s=steps * 0.1)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_accepts_it(task: str) -> None:
    env = gym.make(f"DemoHLM/{task}-v0", controller=HoldController(1), render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for advice in ("(minimum|maximum) value is -?infinity", "we recommend using a symmetric and normalized space"):
            warnings.filterwarnings("ignore", message=f".*{advice}")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_same_seed_same_rollout(task: str) -> None:
    first, second = make(task=task), make(task=task)
    assert_same(first.reset(seed=7)[0], second.reset(seed=7)[0])
    for step in range(3):
        action = actions_for(step, 1)[0]
        assert_same(first.step(action)[0], second.step(action)[0])
    started = first.reset(seed=8)[1]["initial_state"]
    assert started != second.reset(seed=7)[1]["initial_state"]
    assert started != first.reset()[1]["initial_state"]  # np_random goes on


@pytest.mark.parametrize("task", TASKS)
def test_observations(task: str) -> None:
    env = make(task=task)
    seen = []
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        seen.append(np.concatenate([observation["agent_pos"], observation["environment_state"]]))
        for step in range(2):
            observation = env.step(actions_for(step, 1)[0])[0]
            assert env.observation_space.contains(observation)
            seen.append(np.concatenate([observation["agent_pos"], observation["environment_state"]]))
    assert np.isfinite(seen).all()
    names = [*STATE_NAMES, *environment_names(get_task(task))]
    assert len(names) == len(set(names)) == len(seen[0])
    constant = {name for name, spread in zip(names, np.ptp(seen, axis=0), strict=True) if spread == 0.0}
    assert all("gripper" in name for name in constant), constant
    assert all(name.endswith((".pos", ".vel")) for name in names)


def test_observations_and_infos_share_no_memory() -> None:
    env = make_vector(2)
    observation, info = env.reset(seed=0)
    old = {key: value.copy() for key, value in observation.items()}
    later = env.step(actions_for(0, 2))
    for key, value in observation.items():
        np.testing.assert_array_equal(value, old[key])
        assert not np.shares_memory(value, later[0][key])
        value[...] = 0
    for values in (later[1], later[2], later[3], *(later[4][name] for name in FLAGS)):
        values[...] = 1
    assert not env.step(actions_for(1, 2))[4]["fell"].any()
    assert not info["fell"].any()


def test_what_lerobot_asks_for() -> None:
    env = make()
    _, info = env.reset(seed=0)
    assert type(info["is_success"]) is bool
    *_, info = env.step(actions_for(0, 1)[0])
    assert all(type(info[flag]) is bool for flag in FLAGS) and type(info["clipped"]) is int
    assert env.task == "LiftBox" and "box" in env.task_description
    assert env.get_wrapper_attr("_max_episode_steps") == 300
    assert env.metadata["render_fps"] == 10
    vector = make_vector(2)
    vector.reset(seed=[3, 4], options={"lerobot_new_rollout": True})
    assert vector.call("_max_episode_steps") == (300, 300)
    assert vector.call("task_description") == (env.task_description,) * 2
    assert vector.get_attr("task") == ("LiftBox", "LiftBox")
    assert vector.unwrapped.metadata["render_fps"] == 10


def test_many_worlds_are_as_many_single_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, through the ends of episodes and into the next ones; infos as Gymnasium's own vector environment."""
    task = shortened(get_task("LiftBox"), 3)
    monkeypatch.setattr("gym_demohlm.envs.env.get_task", lambda _: task)
    monkeypatch.setattr("gym_demohlm.envs.vector_env.get_task", lambda _: task)
    single = gym.vector.SyncVectorEnv([make] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    vector = make_vector(3, num_threads=2)
    start = {"robot": [0.03, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}  # where the palms touch the box
    for options in ({"initial_state": start}, {"region": "R1"}, None):
        theirs, ours = single.reset(seed=5, options=options), vector.reset(seed=5, options=options)
        assert_same(theirs[0], ours[0])
        assert_infos_alike(theirs[1], ours[1])
        for step in range(5):
            actions = actions_for(step, 3)
            *theirs, their_info = single.step(actions)
            *ours, our_info = vector.step(actions)
            assert_same(theirs[0], ours[0])
            for index in (1, 2, 3):
                np.testing.assert_array_equal(theirs[index], ours[index])
            assert_infos_alike(their_info, our_info)
            assert ours[3].all() == (step == 2)


def test_gymnasium_makes_the_vector_environment() -> None:
    env = gym.make_vec(
        "DemoHLM/LiftBox-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        controller=HoldController(2),
        region="R1",
    )
    assert isinstance(env.unwrapped, DemoHLMVectorEnv) and env.unwrapped.region == "R1"
    first, _ = env.reset(seed=[5, 9])  # pyright: ignore[reportArgumentType]
    second, _ = env.reset(seed=np.array([5, 9]))  # pyright: ignore[reportArgumentType]
    assert_same(first, second)
    assert env.observation_space.contains(first)
    env.close()


def assert_infos_alike(theirs: dict[str, Any], ours: dict[str, Any]) -> None:
    assert theirs.keys() == ours.keys()
    for key, value in theirs.items():
        if key == "final_obs":
            for mine, other in zip(value, ours[key], strict=True):
                assert_same(mine, other)
        elif isinstance(value, dict):
            assert_infos_alike(value, ours[key])
        else:
            assert value.dtype == ours[key].dtype, key
            assert value.tolist() == ours[key].tolist(), key


def test_without_autoreset_a_finished_world_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    task = shortened(get_task("LiftBox"), 2)
    monkeypatch.setattr("gym_demohlm.envs.vector_env.get_task", lambda _: task)
    env = make_vector(2, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    env.step(actions_for(0, 2))
    before, _, _, truncated, _ = env.step(actions_for(1, 2))
    assert truncated.all()
    env.reset(seed=[9, None], options={"reset_mask": np.array([True, False])})
    after, _, _, truncated, _ = env.step(actions_for(2, 2))
    assert truncated.tolist() == [False, True]
    np.testing.assert_array_equal(before["agent_pos"][1], after["agent_pos"][1])
    assert (before["agent_pos"][0] != after["agent_pos"][0]).any()


@pytest.mark.parametrize("mode", [AutoresetMode.DISABLED, AutoresetMode.SAME_STEP])
def test_a_world_that_was_never_begun_is_not_stepped(mode: AutoresetMode) -> None:
    env = make_vector(2, autoreset_mode=mode)
    if mode is AutoresetMode.SAME_STEP:
        with pytest.raises(SceneError, match="call reset first"):
            env.step(actions_for(0, 2))
        return
    seen = [env.reset(seed=[9, None], options={"reset_mask": np.array([True, False])})[0]]
    seen += [env.step(actions_for(index, 2))[0] for index in range(3)]
    states = np.stack([each["agent_pos"] for each in seen])
    assert (states[1:, 1] == states[0, 1]).all()
    assert (states[1:, 0] != states[0, 0]).any()


def test_success_must_last() -> None:
    """The box is held up by hand: the reward starts at once, success and termination come after one second."""
    env = make()
    env.reset(seed=0, options={"initial_state": {"robot": [-0.3, 0.0, 0.0], "object": [0.0, 0.0, 0.0]}})
    action = command.rest().astype(np.float32)
    history = []
    for step in range(HOLD_STEPS + 3):
        if step != 2:  # it is lost once, and the second starts again
            T_world_box = env.sim.pose("box")
            T_world_box[:, :3, 3] = env.sim.pose("pelvis")[:, :3, 3] + [0.45, 0.0, 0.0]
            env.sim.set_pose("box", T_world_box)
            env.sim.set_velocity("box", np.zeros(6))
        _, reward, terminated, _, info = env.step(action)
        history.append((reward, info["success_ever"], info["success_held"], terminated or info["fell"]))
    rewards, ever, held, ended = zip(*history, strict=True)
    assert rewards == (1.0, 1.0, 0.0, *(1.0,) * HOLD_STEPS)
    assert all(ever)
    assert held == (False,) * (HOLD_STEPS + 2) + (True,)
    assert ended[-1]
    assert not info["is_success"]  # without the hand that holds it up, the box falls in the seconds after


def test_a_fall_ends_the_episode() -> None:
    env = make()
    env.reset(seed=0)
    forward = poses.pose([0.0, 0.0, 0.0], [np.cos(0.7), 0.0, np.sin(0.7), 0.0])  # by 80 degrees
    env.sim.set_pose("pelvis", env.sim.pose("pelvis")[0] @ forward)
    _, _, terminated, truncated, info = env.step(command.rest().astype(np.float32))
    assert terminated and info["fell"] and not truncated and not info["is_success"]


def test_options_choose_the_start() -> None:
    env = make(region="R1")
    state = {"robot": [-0.8, 0.1, 0.2], "object": [0.05, -0.1, 1.0]}
    _, info = env.reset(seed=0, options={"initial_state": state})
    assert info["initial_state"] == state
    wide = [env.reset(options={"region": "R3"})[1]["initial_state"]["robot"][0] for _ in range(20)]
    near = [env.reset()[1]["initial_state"]["robot"][0] for _ in range(20)]
    assert min(wide) < -0.6 <= min(near)
    vector = make_vector(2)
    info = vector.reset(seed=0, options={"initial_state": [state, get_task("LiftBox").default_state()]})[1]
    assert info["initial_state"]["robot"].tolist() == [[-0.8, 0.1, 0.2], [-0.3, 0.0, 0.0]]


def test_a_vector_environment_takes_the_initial_states_that_it_gives() -> None:
    env = make_vector(2, variation="real:objects")
    first, infos = env.reset(seed=3)
    again, others = env.reset(options={"initial_state": infos["initial_state"]})
    assert_same(first, again)
    assert_infos_alike(infos, others)
    mask = np.array([False, True])
    _, infos = env.reset(seed=4, options={"reset_mask": mask})
    part = infos["initial_state"]
    _, others = env.reset(options={"initial_state": part, "reset_mask": mask})
    assert_infos_alike(infos, others)
    with pytest.raises(SceneError, match="robot=None"):
        env.reset(options={"initial_state": part})
    with pytest.raises(SceneError, match="a mask beside each array"):
        env.reset(options={"initial_state": {"robot": part["robot"], "object": part["object"], "_robot": mask}})
    with pytest.raises(SceneError, match="2 initial states"):
        make_vector(3).reset(options={"initial_state": part})


@pytest.mark.parametrize("mask", [[1, 0], [True], [[True], [False]], True])
def test_a_mask_of_worlds_is_one_truth_value_each(mask: Any) -> None:
    env = make_vector(2)
    with pytest.raises(SceneError, match="reset_mask="):
        env.reset(seed=0, options={"reset_mask": np.array(mask)})


def test_each_world_is_called_for_its_own_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_vector(2)
    monkeypatch.setattr(env._episodes, "perception_faults", lambda world: {"late": world})
    assert env.call("perception_faults") == ({"late": 0}, {"late": 1})


def test_actions_out_of_bounds_are_clipped_and_counted() -> None:
    env = make()
    env.reset(seed=0)
    action = command.rest().astype(np.float32)
    assert env.step(action)[4]["clipped"] == 0
    action[[0, 3]] = 5.0, 0.0
    assert env.step(action)[4]["clipped"] == 2
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    assert env.step(space.high)[4]["clipped"] == env.step(space.low)[4]["clipped"] == 0  # float32 bounds are inside


def test_bad_input_is_explained() -> None:
    env = make()
    env.reset(seed=0)
    with pytest.raises(CommandError, match=r"base_x\.vel"):
        env.step(np.full(23, np.nan, dtype=np.float32))
    with pytest.raises(CommandError, match=r"\(23,\)"):
        env.step(np.zeros((1, 23), dtype=np.float32))
    with pytest.raises(UnknownNameError, match="did you mean 'LiftBox'"):
        make(task="LiftBoxx")
    with pytest.raises(UnknownNameError, match="R1, R2, R3"):
        make(region="R5")
    for name in ("task", "variation", "perception"):  # None does not mean the default
        with pytest.raises(UnknownNameError, match=f"{name} None"):
            make(**{name: None})
    with pytest.raises(UnknownNameError, match="pixels_agent_pos"):
        make(obs_type="pixels")
    with pytest.raises(UnknownNameError, match="rgb_array"):
        make(render_mode="ansi")
    with pytest.raises(UnknownNameError, match="expected one of rgb_array"):
        make_vector(1, render_mode="human")
    with pytest.raises(SceneError, match="SAME_STEP"):
        make_vector(1, autoreset_mode=AutoresetMode.NEXT_STEP)
    vector = make_vector(2)
    with pytest.raises(SceneError, match="3 seeds"):
        vector.reset(seed=[1, 2, 3])
    for state in (3, {"robot": 5}, {"robot": "here"}):
        with pytest.raises(SceneError, match="initial_state"):
            env.reset(options={"initial_state": state})
