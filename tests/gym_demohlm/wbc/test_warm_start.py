"""A warm start acts as the file that it started from; its worlds differ in load, push and what they know."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from gym_demohlm.control import features
from gym_demohlm.control.settings import Gait, Settings
from gym_demohlm.control.tick import Tick
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, Weights, WholeBodyController
from gym_demohlm.wbc.training.export import export_weights, import_weights
from gym_demohlm.wbc.training.mdp import CRITIC_MIRROR, CRITIC_SIZE, MdpConfig, WholeBodyMdp
from gym_demohlm.wbc.training.model import LARGEST_LOAD, stratified_loads
from gym_demohlm.wbc.training.train_config import TrainConfig, ppo_config
from gym_demohlm.wbc.training.vec_env import MdpVecEnv


def test_a_warm_start_acts_as_its_file_and_so_does_what_it_exports(tmp_path: Path) -> None:
    env = MdpVecEnv(MdpConfig(num_worlds=4, num_variants=2))
    runner = OnPolicyRunner(env, ppo_config(TrainConfig(warm_start=DEFAULT_WEIGHTS)), log_dir=None, device="cpu")
    actor = runner.alg.get_policy()
    import_weights(actor, DEFAULT_WEIGHTS)
    rng = np.random.default_rng(0)
    weights = Weights()
    seen = rng.normal(0, 1.0, (8, features.OBSERVATION_SIZE))
    inputs = len(weights.mean)
    seen[:, :inputs] = weights.mean + seen[:, :inputs] / weights.scale
    expected = WholeBodyController(8)._act(seen)
    with torch.inference_mode():
        found = actor(TensorDict({"actor": torch.from_numpy(seen.astype(np.float32))}, batch_size=[8]))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-3)
    path = tmp_path / "weights.npz"
    settings = Settings(gait=Gait(spread=0.09))
    export_weights(actor, env.mdp.reference, settings, path, {})
    again = WholeBodyController(8, path)
    assert again.settings == settings
    assert len(again.weights.mean) == features.OBSERVATION_SIZE
    np.testing.assert_allclose(again._act(seen), expected, atol=1e-3)


@pytest.mark.parametrize(("symmetric", "use_reference"), [(False, True), (True, False)])
def test_an_export_runs_as_it_was_trained(tmp_path: Path, symmetric: bool, use_reference: bool) -> None:
    env = MdpVecEnv(MdpConfig(num_worlds=4, num_variants=1, use_reference=use_reference))
    runner = OnPolicyRunner(env, ppo_config(TrainConfig(symmetric=symmetric)), log_dir=None, device="cpu")
    actor = runner.alg.get_policy()
    with torch.no_grad():
        for layer in actor.mlp:
            if isinstance(layer, torch.nn.Linear):
                layer.bias.uniform_(-0.3, 0.3)
    export_weights(actor, env.mdp.reference, env.mdp.config.settings, tmp_path / "weights.npz", {})
    controller = WholeBodyController(4, tmp_path / "weights.npz")
    seen = np.random.default_rng(0).normal(0, 1.0, (4, features.OBSERVATION_SIZE))
    with torch.inference_mode():
        expected = actor(TensorDict({"actor": torch.from_numpy(seen.astype(np.float32))}, batch_size=[4]))
    np.testing.assert_allclose(controller._act(seen), expected.numpy(), atol=1e-3)
    now, action = env.mdp.now, np.zeros((4, features.ACTION_SIZE))
    at_run_time = Tick(controller.reference, controller.settings).targets(now, action)
    assert at_run_time.tobytes() == env.mdp._tick.targets(now, action).tobytes()


@pytest.mark.parametrize("count", [1, 4, 32, 100, 128])
def test_loads_fill_the_square_evenly(count: int) -> None:
    loads = stratified_loads(count, np.random.default_rng(1))
    assert loads.shape == (count, 2)
    assert (loads >= 0).all() and (loads <= LARGEST_LOAD).all()
    if count >= 100:
        corner = (loads > LARGEST_LOAD / 2) @ [1, 2]
        assert np.bincount(corner, minlength=4).min() > 0.2 * count


def test_episodes_get_new_loads_and_the_critic_knows_them() -> None:
    mdp = WholeBodyMdp(MdpConfig(num_worlds=16, num_variants=16))
    loads = slice(features.OBSERVATION_SIZE + 10, features.OBSERVATION_SIZE + 12)
    before = mdp.observe()[1][:, loads]
    mdp.reset(np.arange(16))
    after = mdp.observe()[1]
    assert (before != after[:, loads]).any(axis=1).mean() > 0.5
    assert after.shape == (16, CRITIC_SIZE)
    for world in range(16):
        assert mdp._physics._models[world].body_subtreemass[1] == pytest.approx(
            mdp.model.body_subtreemass[1] + (mdp._facts[mdp._variant[world]] - mdp._facts[0])[[0, 1, 3]].sum(), abs=0.03
        )


def test_parts_of_training_can_be_left_out() -> None:
    """Without loads hands are empty; without pushes nobody is pushed; a critic that knows nothing sees zeros."""
    size = {"num_worlds": 4, "num_variants": 4, "seed": 3}
    bare = WholeBodyMdp(MdpConfig(**size, largest_load=0.0, pushed_share=0.0, critic_knows=False))
    full = WholeBodyMdp(MdpConfig(**size))
    bare.push_level = full.push_level = 1.0
    assert (bare._facts[:, :2] == 0).all()
    assert (full._facts[:, :2] > 0).all()
    pushes = []
    for _ in range(MdpConfig().push_every[1]):
        for mdp in (bare, full):
            mdp.step(np.zeros((4, features.ACTION_SIZE)))
        pushes.append((bare.pushed.any(), full.pushed.any()))
    assert np.any(pushes, axis=0).tolist() == [False, True]
    (actor, blind), (_, seeing) = bare.observe(), full.observe()
    assert blind.shape == seeing.shape
    assert (blind[:, actor.shape[1] :] == 0).all()
    assert (seeing[:, actor.shape[1] :] != 0).any(axis=1).all()


def test_the_critics_mirror_is_its_own_inverse() -> None:
    rows = np.random.default_rng(0).normal(size=(3, CRITIC_SIZE))
    twice = features.mirror(features.mirror(rows, CRITIC_MIRROR), CRITIC_MIRROR)
    assert np.array_equal(twice, rows)


def test_a_share_of_the_worlds_is_pushed() -> None:
    mdp = WholeBodyMdp(MdpConfig(num_worlds=10, num_variants=1, pushed_share=0.6, push_every=(3, 6)))
    mdp.push_level = 1.0
    mdp.reset(np.arange(10))
    pushed = np.zeros(10, dtype=bool)
    for _ in range(12):
        mdp._push()
        pushed |= mdp.pushed
    assert pushed.tolist() == [True] * 6 + [False] * 4
