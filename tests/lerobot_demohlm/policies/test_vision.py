"""Policies that see: the small CNN, what presets are given, and a few steps of each."""

import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset, factory

from gym_demohlm.errors import PolicyError, UnknownNameError
from lerobot_demohlm.datasets import in_memory
from lerobot_demohlm.datasets.in_memory import InMemoryDataset
from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig
from lerobot_demohlm.policies.chunked_mlp.modeling_chunked_mlp import ChunkedMLPPolicy
from lerobot_demohlm.policies.chunked_mlp.pictures import PictureEncoder, cropped
from lerobot_demohlm.policies.presets import get_preset, input_features, train_config
from lerobot_demohlm.policies.training import train
from tests.helpers.drawn import write_drawn

STATE, ENV, RGB = "observation.state", "observation.environment_state", "observation.images.head"
SMALL: dict[str, dict[str, Any]] = {
    "mlp": {"hidden_dims": [32], "cnn_channels": [8, 16]},
    "act": {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "use_vae": False},
    "diffusion": {"down_dims": (32, 32), "horizon": 24, "spatial_softmax_num_keypoints": 4},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drawn(tmp_path_factory.mktemp("vision") / "data")


@pytest.mark.parametrize(
    ("policy", "preset"), [("mlp", "vision-cpu"), ("act", "vision-paper"), ("diffusion", "vision-paper")]
)
def test_a_policy_that_sees_trains_for_some_steps(root: Path, tmp_path: Path, policy: str, preset: str) -> None:
    checkpoint = train(tmp_path / "out", root, policy, preset, steps=2, batch_size=2, options=SMALL[policy])
    config = (checkpoint / "config.json").read_text()
    assert RGB in config and ENV not in config and "head_depth" not in config
    assert (checkpoint / "model.safetensors").stat().st_size > 0


def test_policies_without_pictures_leave_them_out(root: Path, tmp_path: Path) -> None:
    given = input_features(root, sees=False)
    assert given is not None and set(given) == {STATE, ENV}
    assert set(input_features(root, sees=True) or {}) == {STATE, RGB}
    assert input_features(tmp_path, sees=False) is None
    with pytest.raises(PolicyError, match="cameras"):
        input_features(tmp_path, sees=True)


def test_pictures_that_a_policy_does_not_look_at_are_not_decoded(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(factory, "LeRobotDataset", LeRobotDataset)
    monkeypatch.setattr(factory, "make_dataset", inspect.unwrap(factory.make_dataset))
    monkeypatch.setattr(in_memory, "is_generated", lambda _: True)
    in_memory.install()
    for preset, pictures in (("cpu", []), ("vision-cpu", [RGB])):
        config = train_config(root, tmp_path / preset, "mlp", preset)
        dataset = factory.make_dataset(config)
        assert isinstance(dataset, InMemoryDataset) and dataset.is_held
        assert dataset.meta.camera_keys == pictures
        assert [key for key in dataset.__getitems__([3]).columns if "images" in key] == pictures
    config.policy.input_features = {}  # LeRobot's training fills in all that there are
    assert RGB in factory.make_dataset(config).meta.camera_keys


def test_a_preset_of_another_policy_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="vision-paper"):
        get_preset("act", "vision-cpu")


def _policy() -> ChunkedMLPPolicy:
    config = ChunkedMLPConfig(device="cpu", hidden_dims=[16], cnn_channels=[8, 8], crop=0.1)
    config.input_features = {
        STATE: PolicyFeature(type=FeatureType.STATE, shape=(3,)),
        RGB: PolicyFeature(type=FeatureType.VISUAL, shape=(3, 32, 32)),
    }
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(2,))}
    torch.manual_seed(0)
    return ChunkedMLPPolicy(config)


def test_what_it_does_depends_on_the_picture_and_not_on_the_others_in_the_batch() -> None:
    policy = _policy()
    batch = {STATE: torch.zeros(4, 3), RGB: torch.rand(4, 3, 32, 32)}
    chunks = policy.predict_action_chunk(batch)
    assert chunks.shape == (4, 20, 2) and not torch.allclose(chunks[0], chunks[1])
    alone = policy.predict_action_chunk({key: value[2:3] for key, value in batch.items()})
    torch.testing.assert_close(alone[0], chunks[2], atol=1e-5, rtol=1e-4)
    loss, _ = policy.forward({**batch, "action": torch.zeros(4, 20, 2)})
    loss.backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in policy.parameters())


def test_the_encoder_tells_where_a_thing_is() -> None:
    torch.manual_seed(0)
    encoder = PictureEncoder(3, ChunkedMLPConfig(device="cpu", cnn_channels=[16, 16]))
    left, right = torch.zeros(1, 3, 32, 32), torch.zeros(1, 3, 32, 32)
    left[..., 10:16, 4:10], right[..., 10:16, 22:28] = 5.0, 5.0
    assert (encoder(left) - encoder(right)).abs().max() > 1e-3


def test_pictures_are_cut_at_random_in_training_and_in_the_middle_else() -> None:
    pictures = torch.arange(100.0).reshape(1, 1, 10, 10)
    middle = cropped(pictures, 0.2, at_random=False)
    assert middle.shape == (1, 1, 8, 8) and middle[0, 0, 0, 0] == 11.0
    assert len({float(cropped(pictures, 0.2, at_random=True)[0, 0, 0, 0]) for _ in range(50)}) > 4
    assert cropped(pictures, 0.0, at_random=True) is pictures
