"""Raw observations -> normalised batch, and normalised actions -> commands: the chunked MLP's processors."""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig

Stats = dict[str, dict[str, Any]]


def floor_std(stats: Stats, floor: float) -> Stats:
    """Return the statistics with every standard deviation raised to at least ``floor``."""
    return {
        key: {
            name: torch.as_tensor(value, dtype=torch.float32).clamp_min(floor) if name == "std" else value
            for name, value in entry.items()
        }
        for key, entry in stats.items()
    }


def make_chunked_mlp_pre_post_processors(
    config: ChunkedMLPConfig,
    dataset_stats: Stats | None = None,
    **kwargs: Any,  # noqa: ANN401
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return LeRobot's default processors, with a floor under the standard deviations."""
    stats = None if dataset_stats is None else floor_std(dataset_stats, config.std_floor)
    return make_default_pre_post_processors(config, stats, normalizer_device=config.device)
