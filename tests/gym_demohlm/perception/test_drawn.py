"""Eyes of episodes that draw how they see: the group ``perception`` of a variation."""

import dataclasses
from collections.abc import Mapping

import gymnasium as gym
import numpy as np
import pytest

import gym_demohlm  # noqa: F401 (registers the environments)
from gym_demohlm.control import command
from gym_demohlm.perception.disturbance import Disturbance
from gym_demohlm.perception.model import ModelPerceiver
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.perception.sight import Sight
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState
from gym_demohlm.variation import Conditions, get_variation

TASK = get_task("GraspCube")
START: InitialState = {"robot": [-0.45, 0.05, 0.1], "object": [0.0, -0.05, 0.3]}
NEUTRAL = {"errors": 0.0, "bias": 0.0, "latency": 0.0, "dropout": 0.0}


def seen(worlds: list[Mapping[str, float]], steps: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (steps, N, 3) that eyes tell and true ones, and ages (steps, N), of robots that stand."""
    sim = Simulation(TASK, len(worlds), variation=get_variation("real:perception"))
    starts = [START | {f"perception.{name}": [value] for name, value in {**NEUTRAL, **each}.items()} for each in worlds]
    sim.reset(starts)
    eyes, rows = Sight(sim, "exact"), np.arange(len(worlds))
    plain = Sight(sim, "exact", get_variation("none"))
    eyes.begin(rows, starts)
    plain.begin(rows, starts)
    told, truth, ages = [], [], []
    for _ in range(steps):
        sim.step(sim.command)
        eyes.look(rows)
        plain.look(rows)
        told.append(eyes.estimate.T_camera_object[:, 0, :3, 3].copy())
        truth.append(plain.estimate.T_camera_object[:, 0, :3, 3].copy())
        ages.append(eyes.estimate.age_s[:, 0].copy())
    eyes.close()
    sim.close()
    return np.array(told), np.array(truth), np.array(ages)


def test_neutral_numbers_are_exact_poses() -> None:
    told, truth, ages = seen([{}])
    np.testing.assert_allclose(told, truth, atol=1e-12)
    assert (ages == 0.0).all()


def test_each_world_has_its_own_bias_errors_latency_and_dropout() -> None:
    told, truth, ages = seen([{}, {"bias": 20.0}, {"errors": 5.0}, {"latency": 0.3}, {"dropout": 1.0}])
    off = np.linalg.norm(told - truth, axis=-1)
    assert off[:, 0].max() < 1e-9
    np.testing.assert_allclose(off[:, 1], 0.020, rtol=1e-6)
    assert 1e-4 < np.median(off[:, 2]) < 0.1
    np.testing.assert_allclose(ages[3:, 3], 0.3)
    np.testing.assert_allclose(ages[:, 4], 0.1 * np.arange(1, len(ages) + 1), atol=1e-9)  # told once, as it began
    assert (ages[:, :2] == 0.0).all()


def test_errors_grow_with_their_factor() -> None:
    """The same seed, so the same draws: three times the factor is three times the error."""
    model = ModelPerceiver(TASK, 2)
    sim = Simulation(TASK, 2)
    sim.reset([START, START])
    model.begin(np.arange(2), [7, 7])
    exact = ModelPerceiver(TASK, 2)
    exact.begin(np.arange(2), [7, 7])
    model.share[:], exact.share[:] = [1.0, 3.0], 0.0
    for _ in range(5):
        told, truth = (each.observe(sim, np.arange(2)).T_camera_object[:, 0, :3, 3] for each in (model, exact))
        np.testing.assert_allclose((told - truth)[1], 3.0 * (told - truth)[0], atol=1e-12)
        assert np.abs(told - truth).max() > 0.0
    sim.close()


def test_what_is_drawn_adds_to_what_is_asked_for() -> None:
    settings = PerceptionSettings.read("model,bias_mm=2,latency_s=0.1,dropout=0.5")
    drawn = {"perception.errors": (2.0,), "perception.bias": (3.0,), "perception.latency": (0.2,)}
    found = Disturbance.of(settings, Conditions(values=drawn | {"perception.dropout": (0.5,)}))
    expected = Disturbance(errors=2.0, bias_mm=5.0, latency_s=0.3, dropout=0.75)
    np.testing.assert_allclose(dataclasses.astuple(found), dataclasses.astuple(expected))
    assert Disturbance.of(settings) == Disturbance(errors=1.0, bias_mm=2.0, latency_s=0.1, dropout=0.5)


@pytest.mark.parametrize("variation", ["real:perception", "real"])
def test_an_environment_repeats_an_episode_from_its_initial_state(variation: str) -> None:
    """The conditions in it decide how the episode sees, bit for bit."""
    env = gym.make("DemoHLM/GraspCube-v0", variation=variation)
    first, info = env.reset(seed=5)
    start = info["initial_state"]
    assert {key for key in start if key.startswith("perception.")} == {f"perception.{name}" for name in NEUTRAL}
    went = [first, *(env.step(command.rest())[0] for _ in range(4))]
    again, _ = env.reset(options={"initial_state": start})
    repeated = [again, *(env.step(command.rest())[0] for _ in range(4))]
    for one, other in zip(went, repeated, strict=True):
        np.testing.assert_array_equal(one["environment_state"], other["environment_state"])
    env.close()


def test_a_task_without_fitted_errors_has_the_others() -> None:
    """So a task from outside the package varies, too."""
    own = dataclasses.replace(TASK, name="Own")
    sim = Simulation(own, 1, variation=get_variation("real:perception"))
    drawn: InitialState = {"perception.errors": [9.0], "perception.bias": [20.0], "perception.latency": [0.0]}
    state = START | drawn | {"perception.dropout": [0.0]}
    sim.reset([state])
    told, rows = [], np.arange(1)
    for variation in ("real:perception", "none"):
        sight = Sight(sim, "exact", get_variation(variation))
        sight.begin(rows, [state])
        told.append(sight.estimate.T_camera_object[0, 0, :3, 3].copy())
        sight.close()
    sim.close()
    assert np.linalg.norm(told[0] - told[1]) == pytest.approx(0.02)


def test_other_groups_keep_exact_poses() -> None:
    told = []
    for variation in ("none", "real:pushes"):
        env = gym.make("DemoHLM/GraspCube-v0", variation=variation)
        told.append(env.reset(seed=5)[0]["environment_state"])
        env.close()
    np.testing.assert_array_equal(*told)
