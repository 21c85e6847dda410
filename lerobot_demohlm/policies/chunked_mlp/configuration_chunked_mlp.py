"""Hyperparameters of the chunked MLP: the paper's table as a LeRobot policy configuration."""

from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

DTYPES = ("float32", "bfloat16")


@OptimizerConfig.register_subclass("fused_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """AdamW in one pass over the weights, which takes a CPU a quarter of the time that PyTorch's default takes."""

    def build(self, params: Any) -> torch.optim.Optimizer:  # noqa: ANN401
        """Return the optimizer of parameters, or of groups of them."""
        options = asdict(self)
        options.pop("grad_clip_norm")  # the trainer's
        return torch.optim.AdamW(params, fused=True, **options)


@PreTrainedConfig.register_subclass("chunked_mlp")
@dataclass
class ChunkedMLPConfig(PreTrainedConfig):
    """Configuration of ``ChunkedMLPPolicy``.

    The paper (appendix, "The MLP architecture and training hyperparameters") gives 4 layers, "1-hidden dim 512",
    "2-hidden dim 2048", learning rate 5e-5, batch size 512 and chunk size 20. Four linear layers have three hidden
    widths, the table names two; read as a feed-forward block (narrow, wide, narrow) they are 512, 2048, 512, which is
    the default here. The batch size belongs to the trainer: ``lerobot-train --batch_size=512``.
    """

    chunk_size: int = 20
    """Actions predicted at once, at 10 Hz [steps]."""
    n_action_steps: int = 10
    """Actions carried out before the next prediction [steps]; the paper gives it for Diffusion Policy only: 10."""
    hidden_dims: list[int] = field(default_factory=lambda: [512, 2048, 512])
    """Widths between the linear layers; one layer more than there are widths."""
    dropout: float = 0.0
    """Share of hidden units dropped in training; the paper names none."""
    std_floor: float = 0.01
    """Smallest standard deviation used for normalisation, in each dimension's own unit (rad, rad/s, m, ...).

    A joint that hardly moves in the data would otherwise turn a deviation of a milliradian into a huge input. Less than
    0.01 has no effect with generated datasets, whose statistics have that floor. LeRobot's trainer takes the statistics
    of the dataset as they are where a policy goes on being trained (``--policy.path``).
    """
    input_clip: float = 10.0
    """Normalised inputs are clipped to +- this, so that a state far from the data cannot blow up the output."""
    dtype: str = "float32"
    """Precision of the matrix products of a training, "float32" or "bfloat16", read by LeRobot's trainer.

    Weights, optimizer and loss are float32 with either, and so is all of a policy that acts.
    """

    cnn_channels: list[int] = field(default_factory=lambda: [32, 64, 64, 64])
    """Channels of the convolutions that see each camera's picture, each halving its sides; unused without pictures."""
    cnn_features: int = 64
    """Numbers that a picture becomes."""
    crop: float = 0.0
    """Share of a picture's side that training cuts off at random places, and acting in the middle."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,  # LeRobot leaves ENV as it is unless it is named
            "ACTION": NormalizationMode.MEAN_STD,
            "VISUAL": NormalizationMode.MEAN_STD,
        }
    )

    optimizer_lr: float = 5e-5
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 10.0
    scheduler_warmup_steps: int | None = None
    """None, as in the paper: constant learning rate. A number: this much linear warmup, then a cosine down to zero."""

    def __post_init__(self) -> None:
        """Check what the model is built from."""
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"got n_action_steps={self.n_action_steps}; expected 1 to chunk_size={self.chunk_size}; "
                "lower --policy.n_action_steps or raise --policy.chunk_size"
            )
        if self.n_obs_steps != 1:
            raise ValueError(f"got n_obs_steps={self.n_obs_steps}; expected 1; this policy sees the present only")
        if not self.hidden_dims or min(self.hidden_dims) < 1:
            raise ValueError(f"got hidden_dims={self.hidden_dims}; expected positive widths; name at least one")
        if not 0 <= self.dropout < 1 or self.std_floor <= 0 or self.input_clip <= 0:
            raise ValueError(
                f"got dropout={self.dropout}, std_floor={self.std_floor}, input_clip={self.input_clip}; "
                "expected 0 <= dropout < 1 and the others above 0; correct them"
            )
        if not self.cnn_channels or min(self.cnn_channels) < 1 or self.cnn_features < 1 or not 0 <= self.crop < 0.5:
            raise ValueError(
                f"got cnn_channels={self.cnn_channels}, cnn_features={self.cnn_features}, crop={self.crop}; expected "
                "positive numbers and a crop of 0 to 0.5; correct them"
            )
        if self.dtype not in DTYPES:
            raise ValueError(f"got dtype={self.dtype!r}; expected one of {', '.join(DTYPES)}; correct --policy.dtype")

    def validate_features(self) -> None:
        """Check that there is something to look at and an action to predict."""
        if self.robot_state_feature is None and self.env_state_feature is None and not self.image_features:
            raise ValueError(
                f"got inputs {sorted(self.input_features or {})}; expected observation.state or "
                "observation.environment_state; use a dataset with one of them"
            )
        if self.action_feature is None:
            raise ValueError(
                f"got outputs {sorted(self.output_features or {})}; expected action; use a dataset with actions"
            )

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        """Return the optimizer that ``lerobot-train`` builds."""
        return FusedAdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig | None:
        """Return the learning-rate schedule that ``lerobot-train`` builds."""
        if self.scheduler_warmup_steps is None:
            return None
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def observation_delta_indices(self) -> None:
        """Observations: the present only."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """Actions: from the present one on."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
