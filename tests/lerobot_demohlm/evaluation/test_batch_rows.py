"""Rows in blocks of 16: filled up and cut back, and the same bits for a row whatever is beside it."""

from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class

from lerobot_demohlm.evaluation.batch_rows import BLOCK, row_processors
from lerobot_demohlm.policies.presets import get_preset, policy_config


def test_rows_are_filled_up_and_cut_back() -> None:
    fill, cut = row_processors()
    states = torch.arange(6.0).reshape(3, 2)
    filled = fill({"observation.state": states, "task": ["lift"] * 3})
    assert filled["observation.state"].shape == (BLOCK, 2)
    assert torch.equal(filled["observation.state"][:3], states)
    assert torch.equal(filled["observation.state"][3:], states[:1].expand(BLOCK - 3, 2))
    assert filled["task"] == ["lift"] * BLOCK
    actions = torch.rand(BLOCK, 4)
    assert torch.equal(cut({"action": actions})["action"], actions[:3])


@pytest.mark.parametrize("key", ["observation.state", "observation.images.head"])
def test_whole_blocks_and_images_are_left_as_they_are(key: str) -> None:
    fill, cut = row_processors()
    count = BLOCK if key == "observation.state" else 2
    assert fill({key: torch.zeros(count, 3), "task": ["lift"] * count})[key].shape == (count, 3)
    assert cut({"action": torch.zeros(count, 4)})["action"].shape == (count, 4)


@pytest.mark.parametrize(("policy", "precision"), [("mlp", "float32"), ("act", "float32"), ("act", "bfloat16")])
def test_a_row_has_the_same_bits_in_any_batch(policy: str, precision: str) -> None:
    torch.manual_seed(0)
    config: Any = policy_config(get_preset(policy, "cpu"), steps=10)
    config.input_features = {
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(68,)),
        "observation.environment_state": PolicyFeature(type=FeatureType.ENV, shape=(9,)),
    }
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(23,))}
    network = get_policy_class(config.type)(config)
    seen = {"observation.state": torch.randn(40, 68), "observation.environment_state": torch.randn(40, 9)}
    fill, cut = row_processors()

    def act(rows: list[int]) -> torch.Tensor:
        batch = fill({key: value[rows] for key, value in seen.items()} | {"task": ["lift"] * len(rows)})
        with torch.autocast("cpu", enabled=precision == "bfloat16"):
            return cut({"action": network.predict_action_chunk(batch)[:, 0]})["action"]

    whole = act(list(range(40)))
    for rows in ([0], [39], [3, 2, 1], list(range(17)), list(range(39, 5, -1))):
        assert torch.equal(act(rows), whole[rows])
