"""The chunked MLP: shapes, padding, action queue, normalisation with a floor, save and load, and that it learns."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from torch import Tensor, nn

from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig, FusedAdamWConfig
from lerobot_demohlm.policies.chunked_mlp.modeling_chunked_mlp import ChunkedMLPPolicy
from lerobot_demohlm.policies.chunked_mlp.processor_chunked_mlp import floor_std, make_chunked_mlp_pre_post_processors

SIZES = {"observation.state": 6, "observation.environment_state": 3, "action": 4}


def make_config(**changes: object) -> ChunkedMLPConfig:
    values: dict = {"chunk_size": 5, "n_action_steps": 2, "hidden_dims": [16, 32]}
    config = ChunkedMLPConfig(device="cpu", push_to_hub=False, **(values | changes))
    config.input_features = {
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(6,)),
        "observation.environment_state": PolicyFeature(type=FeatureType.ENV, shape=(3,)),
    }
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(4,))}
    return config


def make_policy(**changes: object) -> ChunkedMLPPolicy:
    torch.manual_seed(0)
    return ChunkedMLPPolicy(make_config(**changes), dataset_stats={}, dataset_meta=None)


def make_batch(size: int = 7, chunk: int = 5) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    batch = {key: torch.randn(size, width, generator=generator) for key, width in SIZES.items()}
    batch["action"] = torch.randn(size, chunk, 4, generator=generator)
    batch["action_is_pad"] = torch.zeros(size, chunk, dtype=torch.bool)
    return batch


def make_stats() -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    return {
        key: {"mean": rng.normal(size=width), "std": rng.uniform(0.5, 2, size=width)} for key, width in SIZES.items()
    }


def test_the_papers_table_is_the_default() -> None:
    config = ChunkedMLPConfig(device="cpu")
    assert (config.chunk_size, config.hidden_dims, len(config.hidden_dims) + 1) == (20, [512, 2048, 512], 4)
    assert config.get_optimizer_preset().lr == 5e-5
    assert config.get_scheduler_preset() is None
    modes = {name: config.normalization_mapping[name] for name in ("STATE", "ENV", "ACTION")}
    assert set(modes.values()) == {NormalizationMode.MEAN_STD}
    assert config.action_delta_indices == list(range(20))


def test_registered_with_lerobot() -> None:
    assert isinstance(make_policy_config("chunked_mlp", device="cpu"), ChunkedMLPConfig)
    assert get_policy_class("chunked_mlp") is ChunkedMLPPolicy


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_action_steps": 6}, "n_action_steps=6"),
        ({"n_action_steps": 0}, "n_action_steps=0"),
        ({"n_obs_steps": 2}, "n_obs_steps=2"),
        ({"hidden_dims": []}, "hidden_dims"),
        ({"std_floor": 0.0}, "std_floor"),
        ({"dropout": 1.0}, "dropout"),
        ({"dtype": "float16"}, "dtype='float16'"),
    ],
)
def test_impossible_configurations_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_config(**changes)


@pytest.mark.parametrize(("missing", "message"), [("input_features", "inputs"), ("output_features", "outputs")])
def test_missing_features_are_refused(missing: str, message: str) -> None:
    config = make_config()
    setattr(config, missing, {})
    with pytest.raises(ValueError, match=message):
        ChunkedMLPPolicy(config)


def test_padded_steps_do_not_count() -> None:
    policy, batch = make_policy(), make_batch()
    loss, info = policy.forward(batch)
    batch["action_is_pad"][:, 3:] = True
    masked = policy.forward(batch)[0]
    batch["action"][:, 3:] = 1e6
    assert torch.equal(policy.forward(batch)[0], masked)
    assert not torch.isclose(loss, masked)
    assert info["l1_loss"] == pytest.approx(loss.item())
    error = (policy.predict_action_chunk(batch) - batch["action"])[:, :3].abs().mean()
    torch.testing.assert_close(masked, error)


def test_losses_of_samples_average_to_the_loss() -> None:
    policy, batch = make_policy(), make_batch()
    losses, _ = policy.forward(batch, reduction="none")
    assert losses.shape == (7,)
    torch.testing.assert_close(losses.mean(), policy.forward(batch)[0])


def test_queue_gives_the_chunk_action_by_action() -> None:
    policy, first, second = make_policy(), make_batch(3), make_batch(3)
    second["observation.state"] = second["observation.state"] + 1
    expected, later = policy.predict_action_chunk(first), policy.predict_action_chunk(second)
    assert expected.shape == (3, 5, 4)
    torch.testing.assert_close(policy.select_action(first), expected[:, 0])
    torch.testing.assert_close(policy.select_action(second), expected[:, 1])  # from the queue, not from what is seen
    torch.testing.assert_close(policy.select_action(second), later[:, 0])
    policy.reset()
    torch.testing.assert_close(policy.select_action(first), expected[:, 0])


def test_rows_of_a_batch_do_not_mix() -> None:
    policy, batch = make_policy(), make_batch(4)
    one = {key: value[2:3] for key, value in batch.items()}
    torch.testing.assert_close(policy.predict_action_chunk(one)[0], policy.predict_action_chunk(batch)[2])


def test_inputs_are_clipped() -> None:
    policy, batch = make_policy(), make_batch()
    batch["observation.state"][:] = 10.0
    at_bound = policy.predict_action_chunk(batch)
    batch["observation.state"][:] = 1e9
    torch.testing.assert_close(policy.predict_action_chunk(batch), at_bound)


def test_floor_under_standard_deviations() -> None:
    stats = make_stats()
    stats["observation.state"]["std"][1] = 0.0
    stats["action"]["std"][2] = 1e-9
    floored = floor_std(stats, 0.01)
    assert float(floored["observation.state"]["std"][1]) == pytest.approx(0.01)
    np.testing.assert_array_equal(floored["observation.state"]["mean"], stats["observation.state"]["mean"])
    before, after = make_chunked_mlp_pre_post_processors(make_config(), stats)
    seen = torch.as_tensor(stats["observation.state"]["mean"], dtype=torch.float32).clone()
    seen[1] += 0.02
    batch = before({"observation.state": seen[None], "observation.environment_state": torch.zeros(1, 3)})
    torch.testing.assert_close(batch["observation.state"][0], torch.tensor([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    expected = -stats["observation.environment_state"]["mean"] / stats["observation.environment_state"]["std"]
    np.testing.assert_allclose(batch["observation.environment_state"][0], expected, rtol=1e-5)
    action = after(torch.ones(1, 4))[0]
    assert float(action[2]) == pytest.approx(stats["action"]["mean"][2] + 0.01, abs=1e-6)


def test_save_and_load(tmp_path: Path) -> None:
    policy, batch = make_policy(std_floor=0.05), make_batch()
    before, after = make_chunked_mlp_pre_post_processors(policy.config, make_stats())
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    loaded = ChunkedMLPPolicy.from_pretrained(tmp_path)
    assert (loaded.config.hidden_dims, loaded.config.std_floor) == ([16, 32], 0.05)
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    loaded_before, loaded_after = make_pre_post_processors(loaded.config, pretrained_path=str(tmp_path))
    for key in ("observation.state", "observation.environment_state"):
        torch.testing.assert_close(loaded_before(dict(batch))[key], before(dict(batch))[key])
    torch.testing.assert_close(loaded_after(batch["action"][:, 0]), after(batch["action"][:, 0]))


def test_one_pass_over_the_weights_is_adamw() -> None:
    weights = [nn.Parameter(torch.linspace(-1, 1, 5)) for _ in range(2)]
    options: dict[str, Any] = {"lr": 0.03, "betas": (0.8, 0.9), "eps": 1e-6, "weight_decay": 0.1}
    optimizers = [FusedAdamWConfig(**options).build([weights[0]]), torch.optim.AdamW([weights[1]], **options)]
    for step in range(20):
        for weight, optimizer in zip(weights, optimizers, strict=True):
            weight.grad = torch.sin(7 * weight.detach() + step)
            optimizer.step()
    torch.testing.assert_close(weights[0], weights[1])


def test_it_learns_a_linear_controller() -> None:
    policy = make_policy(optimizer_lr=3e-3, scheduler_warmup_steps=10)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    preset = policy.config.get_scheduler_preset()
    assert preset is not None
    scheduler = preset.build(optimizer, 300)
    assert scheduler is not None
    generator = torch.Generator().manual_seed(2)
    gains = torch.randn(9, 4, generator=generator)

    def batch() -> dict[str, Tensor]:
        state, environment = torch.randn(128, 6, generator=generator), torch.randn(128, 3, generator=generator)
        action = (torch.cat([state, environment], dim=-1) @ gains)[:, None].expand(-1, 5, -1)
        return {"observation.state": state, "observation.environment_state": environment, "action": action}

    start = policy.forward(batch())[0].item()
    for _ in range(300):
        loss, _ = policy.forward(batch())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
    assert policy.forward(batch())[0].item() < 0.15 * start
    assert optimizer.param_groups[0]["lr"] < 1e-6
