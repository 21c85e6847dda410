"""LeRobot's vision-language policies start on datasets with pictures: one training step of tiny random weights.

The robot's state has more numbers than most of them expect, which ``max_state_dim`` says. A depth picture has one
channel where they expect three: their input features leave it out, or, as GR00T packs every picture of a dataset, the
dataset itself.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.groot.configuration_groot import GrootConfig
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from gym_demohlm.envs import observation
from tests.helpers import tiny_vlm
from tests.helpers.drawn import write_drawn

pytestmark = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("transformers", "num2words", "tree")),
    reason="the extra vla is not installed",
)
SIZE = len(observation.STATE_NAMES)
PLAIN: dict[str, Any] = {"chunk_size": 4, "n_action_steps": 4, "device": "cpu", "push_to_hub": False}


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
    config = SmolVLAConfig(
        vlm_model_name=str(tiny_vlm.write_smolvlm(tmp_path / "vlm")), load_vlm_weights=False, max_state_dim=SIZE,
        max_action_dim=32, resize_imgs_with_padding=(tiny_vlm.PICTURE, tiny_vlm.PICTURE), num_vlm_layers=2, **PLAIN,
    )  # fmt: skip
    loss, changed = first_step(config, write_drawn(tmp_path / "data"))
    assert 0.0 < loss < 100.0 and changed > 10


@pytest.mark.parametrize(("modeling", "config"), [(modeling_pi0, PI0Config), (modeling_pi05, PI05Config)])
def test_pi_takes_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, modeling: Any, config: Any) -> None:
    """LeRobot knows two sizes of Gemma, the smaller of 300 million weights, so both are made small here."""
    small = modeling.GemmaConfig(width=32, depth=2, mlp_dim=32, num_heads=8, num_kv_heads=1, head_dim=8)
    monkeypatch.setattr(modeling, "get_gemma_config", lambda variant: small)
    whole = modeling.PaliGemmaForConditionalGenerationWithPiGemma
    monkeypatch.setattr(modeling, whole.__name__, tiny_vlm.small_paligemma(whole))
    tiny_vlm.write_paligemma_tokenizer(tmp_path)
    monkeypatch.chdir(tmp_path)
    side = tiny_vlm.PICTURE
    loss, changed = first_step(
        config(max_state_dim=SIZE, image_resolution=(side, side), **PLAIN), write_drawn(tmp_path / "data")
    )
    assert 0.0 < loss < 100.0 and changed > 10


def test_groot_takes_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = GrootConfig(base_model_path=str(tiny_vlm.write_groot(tmp_path)), use_bf16=False, **PLAIN)
    loss, changed = first_step(config, write_drawn(tmp_path / "data", streams=("rgb",)))
    assert 0.0 < loss < 100.0 and changed > 10
