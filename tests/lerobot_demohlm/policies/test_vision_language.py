"""LeRobot's vision-language policies start on datasets with pictures: one training step of tiny random weights."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

from gym_demohlm.envs import observation
from tests.helpers.drawn import write_drawn

SIZE = len(observation.STATE_NAMES)
"""The robot's state is longer than the 32 numbers that these policies expect; ``max_state_dim`` says so.

A depth picture has one channel where they expect three, so their input features leave it out."""


def first_step(config: Any, root: Path) -> tuple[float, int]:
    """Train a policy for one step; returns its loss and how many of its weights have changed."""
    torch.manual_seed(0)
    meta = LeRobotDataset("local/drawn", root=root).meta
    features = dataset_to_policy_features(meta.features)
    config.input_features = {key: features[key] for key in ("observation.state", "observation.images.head")}
    config.output_features = {key: found for key, found in features.items() if found.type is FeatureType.ACTION}
    dataset = LeRobotDataset("local/drawn", root=root, delta_timestamps=resolve_delta_timestamps(config, meta))
    policy = make_policy(config, ds_meta=meta)
    prepare, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    batch = prepare(next(iter(torch.utils.data.DataLoader(dataset, batch_size=2))))
    policy.train()
    before = [weights.detach().clone() for weights in policy.parameters()]
    optimizer = torch.optim.SGD([weights for weights in policy.parameters() if weights.requires_grad], lr=1.0)
    loss, _ = policy.forward(batch)
    loss.backward()
    optimizer.step()
    changed = [not torch.equal(old, new) for old, new in zip(before, policy.parameters(), strict=True)]
    return float(loss.detach()), sum(changed)


def test_smolvla_takes_a_step(tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="LeRobot's extra smolvla is not installed")
    pytest.importorskip("num2words", reason="LeRobot's extra smolvla is not installed")
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

    from tests.helpers.tiny_vlm import PICTURE, write_smolvlm

    config = SmolVLAConfig(
        vlm_model_name=str(write_smolvlm(tmp_path / "vlm")), load_vlm_weights=False, chunk_size=4, n_action_steps=4,
        max_state_dim=SIZE, max_action_dim=32, resize_imgs_with_padding=(PICTURE, PICTURE), num_vlm_layers=2,
        device="cpu", push_to_hub=False,
    )  # fmt: skip
    loss, changed = first_step(config, write_drawn(tmp_path / "data"))
    assert 0.0 < loss < 100.0 and changed > 10
