"""Checkpoints of small policies with given features, made without training."""

from pathlib import Path

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature

from gym_demohlm.control import command
from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig
from lerobot_demohlm.policies.chunked_mlp.modeling_chunked_mlp import ChunkedMLPPolicy
from lerobot_demohlm.policies.chunked_mlp.processor_chunked_mlp import make_chunked_mlp_pre_post_processors

SIZES = {"observation.state": 68, "observation.environment_state": 9, "action": 23}


def save_policy(path: Path, *, state_size: int = 68, scale: float = 0.0) -> Path:
    """Write the checkpoint of a policy that stands still, or fidgets where it is given weights of a scale."""
    config = ChunkedMLPConfig(device="cpu", push_to_hub=False, hidden_dims=[16], chunk_size=4, n_action_steps=3)
    config.input_features = {
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(state_size,)),
        "observation.environment_state": PolicyFeature(type=FeatureType.ENV, shape=(9,)),
    }
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(23,))}
    policy = ChunkedMLPPolicy(config)
    torch.manual_seed(0)
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=scale)
    stats = {key: {"mean": np.zeros(size), "std": np.ones(size)} for key, size in SIZES.items()}
    stats["observation.state"] = {"mean": np.zeros(state_size), "std": np.ones(state_size)}
    stats["action"]["mean"] = command.rest()
    for part in (policy, *make_chunked_mlp_pre_post_processors(config, stats)):
        part.save_pretrained(path)
    return path
