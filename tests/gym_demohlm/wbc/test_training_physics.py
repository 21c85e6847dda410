"""The training physics: mujoco.rollout equals mj_step, mujoco_warp equals mujoco.rollout, models that do not fit."""

import copy
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gym_demohlm.control import features
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import SECOND
from gym_demohlm.wbc.training.model import SUBSTEPS, training_model
from gym_demohlm.wbc.training.physics import STATE, RolloutPhysics, check_models, make_physics

_WORLDS = 6
_HOME = g1.HOME[features.OBSERVED_INDEX]


@pytest.fixture(scope="module")
def models() -> list[mujoco.MjModel]:
    rng = np.random.default_rng(0)
    return [training_model(rng) for _ in range(3)]


def _standing(model: mujoco.MjModel, num_worlds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States (N, .) of robots a little off their home pose, soles at the floor, and targets (N, SUBSTEPS, 23)."""
    rng = np.random.default_rng(seed)
    state = np.zeros((num_worlds, mujoco.mj_stateSize(model, STATE)))
    qpos, qvel = state[:, 1 : 1 + model.nq], state[:, 1 + model.nq :]
    qpos[:, 2], qpos[:, 3] = g1.PELVIS_HEIGHT, 1.0
    qpos[:, 7:] = _HOME + rng.normal(0, 0.03, (num_worlds, len(_HOME)))
    qvel[:] = rng.normal(0, 0.1, qvel.shape)
    return state, _HOME + rng.normal(0, 0.05, (num_worlds, SUBSTEPS, len(_HOME)))


def _converge(model: mujoco.MjModel) -> mujoco.MjModel:
    """Let the solver go on to the end: in the few iterations of training, two of them stop at different points."""
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    return model


def test_rollout_is_mj_step_of_each_worlds_model(models: list[mujoco.MjModel]) -> None:
    state, control = _standing(models[0], _WORLDS, seed=1)
    arrived, sensors = RolloutPhysics(models, _WORLDS, num_threads=2).step(state, control)
    for world in range(_WORLDS):
        model = models[world % len(models)]
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, state[world], STATE)
        for targets in control[world]:
            data.ctrl[:] = targets
            mujoco.mj_step(model, data)
        expected = np.zeros(state.shape[1])
        mujoco.mj_getState(model, data, expected, STATE)
        assert np.array_equal(arrived[world], expected)
        assert np.array_equal(sensors[world], data.sensordata)


def test_models_of_different_layouts_are_refused(models: list[mujoco.MjModel]) -> None:
    other = mujoco.MjModel.from_xml_string("<mujoco/>")
    for wrong in ([], [models[0], other]):
        with pytest.raises(SceneError, match="layouts"):
            check_models(wrong)


def test_physics_is_rollout_unless_a_device_is_named(models: list[mujoco.MjModel]) -> None:
    physics = make_physics(models, _WORLDS, SUBSTEPS, num_threads=1, warp_device=None)
    assert isinstance(physics, RolloutPhysics)


def test_unknown_device_is_refused(models: list[mujoco.MjModel]) -> None:
    with pytest.raises(SceneError, match=r"one of .*cpu"):
        make_physics(models, _WORLDS, SUBSTEPS, num_threads=1, warp_device="abacus")


def test_what_worlds_must_share_may_not_differ(models: list[mujoco.MjModel]) -> None:
    other = training_model(np.random.default_rng(5))
    other.site_size[:] *= 2
    with pytest.raises(SceneError, match="site_size"):
        make_physics([*models, other], _WORLDS, SUBSTEPS, num_threads=1, warp_device="cpu")


@pytest.mark.slow  # compiles the kernels of mujoco_warp for the CPU: minutes the first time
def test_warp_agrees_with_rollout(models: list[mujoco.MjModel]) -> None:
    """A control tick of four steps at float32's precision, in worlds that touch the floor, all sensors included.

    Tolerances: 7 digits of numbers up to 1 (positions), of accelerations of up to 1e3 rad/s2 times 0.02 s (velocities),
    of forces of hundreds of newtons through stiff contacts (touch); about ten times what is seen.
    """
    converged = [_converge(copy.copy(model)) for model in models]
    slow = RolloutPhysics(converged, _WORLDS)
    warp = make_physics(converged, _WORLDS, SUBSTEPS, num_threads=1, warp_device="cpu")
    model = converged[0]
    tolerance = np.full(model.nsensordata, 1e-5)
    for sensor in map(model.sensor, range(model.nsensor)):
        first = sensor.adr[0]
        tolerance[first : first + sensor.dim[0]] = {"vel": 5e-4, "touch": 0.5}.get(sensor.name.split("_")[-1], 1e-5)
    state, _ = _standing(model, _WORLDS, seed=2)
    touched = 0.0
    for tick in range(8):
        _, control = _standing(model, _WORLDS, seed=10 + tick)
        expected, readings = slow.step(state, control)
        arrived, warp_readings = warp.step(state, control)
        difference = np.abs(arrived - expected)
        assert difference[:, : 1 + model.nq].max() < 1e-5
        assert difference[:, 1 + model.nq :].max() < 5e-4
        assert (np.abs(warp_readings - readings) < tolerance).all()
        touched = max(touched, readings.max())
        state = expected
    assert touched > 50.0  # the feet stood on the floor
    first_model_only, _ = RolloutPhysics(converged[:1], _WORLDS).step(state, control)
    apart = np.abs(first_model_only - slow.step(state, control)[0])[:, 1 + model.nq :].max(axis=1)
    assert (apart[[1, 2, 4, 5]] > 0.01).all()  # the variants differ by more than the tolerance: none was mixed up


@pytest.mark.slow
def test_mdp_is_the_same_on_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    from gym_demohlm.wbc.training import mdp as module

    made = module.variants
    monkeypatch.setattr(module, "variants", lambda *given: [replace(v, model=_converge(v.model)) for v in made(*given)])
    monkeypatch.setattr(RolloutPhysics, "assign", lambda *_: False)  # a world on warp keeps its model for good
    config = module.MdpConfig(num_worlds=12, num_variants=3)
    plain, warp = module.WholeBodyMdp(config), module.WholeBodyMdp(replace(config, warp_device="cpu"))
    for tick in range(4):
        actions = np.random.default_rng(tick).normal(0, 0.2, (12, features.ACTION_SIZE))
        (reward, fell, _), (warp_reward, warp_fell, _) = plain.step(actions), warp.step(actions)
        np.testing.assert_allclose(warp_reward, reward, atol=1e-4)
        assert np.array_equal(warp_fell, fell)
    (actor, critic), (warp_actor, warp_critic) = plain.observe(), warp.observe()
    np.testing.assert_allclose(warp_actor, actor, atol=1e-4)
    np.testing.assert_allclose(warp_critic, critic, atol=5e-3)  # it feels the soles' forces


@pytest.mark.slow
def test_a_broken_world_breaks_no_other_on_warp(models: list[mujoco.MjModel]) -> None:
    warp = make_physics(models, _WORLDS, SUBSTEPS, num_threads=1, warp_device="cpu")
    state, control = _standing(models[0], _WORLDS, seed=4)
    expected, readings = warp.step(state, control)
    broken = state.copy()
    broken[2, 1:] = np.nan
    arrived, broken_readings = warp.step(broken, control)
    others = np.arange(_WORLDS) != 2
    assert np.isnan(arrived[2]).any()
    np.testing.assert_allclose(arrived[others], expected[others], atol=1e-5)
    assert np.isfinite(broken_readings[others]).all()
    np.testing.assert_allclose(warp.step(state, control)[1], readings, atol=1e-2)  # and it is mended by a new state


@pytest.mark.slow
def test_trains_on_warp(tmp_path: Path) -> None:
    from gym_demohlm.wbc.training.mdp import MdpConfig
    from gym_demohlm.wbc.training.train import train
    from gym_demohlm.wbc.training.train_config import TrainConfig

    mdp = MdpConfig(num_worlds=16, num_variants=2, warp_device="cpu")
    config = TrainConfig(mdp=mdp, num_processes=1, steps_per_iteration=4)
    train(tmp_path / "run", config, hours=1e-4)
    assert (tmp_path / "run" / "weights.npz").exists()


def test_configurations_of_cpu_and_gpu_share_the_mdp() -> None:
    from gym_demohlm.wbc.training.train_config import TrainConfig, cpu_config, cuda_config

    cpu, cuda = cpu_config(2), cuda_config()
    assert (cpu.mdp.warp_device, cpu.device, cpu.num_processes * cpu.mdp.num_worlds) == (None, "cpu", 512)
    assert (cuda.mdp.warp_device, cuda.device, cuda.num_processes * cuda.mdp.num_worlds) == ("cuda", "cuda", 4096)
    with pytest.raises(SceneError, match="one process"):
        TrainConfig(num_processes=2, device="cuda")


def test_commands_at_which_robots_fell_come_back_with_the_one_before() -> None:
    from gym_demohlm.wbc.training.commands import CommandSampler

    sampler = CommandSampler(64, np.random.default_rng(0))
    sampler.reset(np.arange(64), 1.0)
    for _ in range(301):  # everyone has a second command
        sampler.advance(1.0)
    before, fell_at = sampler.previous[3].copy(), sampler.goal[3].copy()
    sampler.remember(np.array([3]))
    practised = 0
    for _ in range(3000):
        was = sampler.goal.copy()
        sampler.advance(1.0)
        again = (was != sampler.goal).any(axis=1) & (sampler.goal == fell_at).all(axis=1)
        practised += again.sum()
        assert (was[again] == before).all()
    assert practised > 0.05 * 64 * 3000 / 200  # draws last 200 ticks on average


def test_a_gpu_has_room_for_every_contact_and_constraint() -> None:
    """Also of feet that touch each other, and of dry joints, which some of the models have."""
    warp_physics = pytest.importorskip("gym_demohlm.wbc.training.warp_physics")
    rng = np.random.default_rng(0)
    names = [g1.BODY_JOINTS[joint] for joint in features.OBSERVED_INDEX]
    rolls = [7 + names.index(f"{side}_hip_roll") for side in g1.SIDES]
    found = []
    for model in (training_model(rng, physics=SECOND) for _ in range(8)):
        contacts, rows = warp_physics.most_contacts_and_rows(model)
        data = mujoco.MjData(model)
        for inwards in np.linspace(0.0, 0.3, 40):
            data.qpos[:7] = 0.0, 0.0, g1.PELVIS_HEIGHT - 0.01, 1.0, 0.0, 0.0, 0.0
            data.qpos[7:] = _HOME + rng.normal(0.0, 0.02, len(_HOME))
            data.qpos[rolls] += -inwards, inwards
            mujoco.mj_forward(model, data)
            assert data.ncon <= contacts and data.nefc <= rows
            found.append(data.nefc)
        assert rows >= 79  # the most of 14,000 narrow stances
    assert max(found) > 50, "feet touch each other"
