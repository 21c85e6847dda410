"""The chunked MLP: robot state, object poses, pictures -> the next ``chunk_size`` actions, by one network."""

from collections import deque
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn

from lerobot_demohlm.policies.chunked_mlp.configuration_chunked_mlp import ChunkedMLPConfig
from lerobot_demohlm.policies.chunked_mlp.pictures import PictureEncoder, cropped


class ChunkedMLPPolicy(PreTrainedPolicy):
    """Behaviour cloning with an MLP that predicts a chunk of actions.

    The loss is L1 on normalised actions, as ACT's: demonstrated commands jump (a walk stops, a hand closes), and the
    median of two ways on is one of them, their mean is neither. Steps past the end of an episode do not count.
    """

    config_class = ChunkedMLPConfig  # pyright: ignore[reportAssignmentType]  (LeRobot declares None)
    name = "chunked_mlp"  # pyright: ignore[reportAssignmentType]

    def __init__(self, config: ChunkedMLPConfig, **kwargs: Any) -> None:  # noqa: ANN401
        """Build the network; LeRobot passes further keywords (statistics, metadata) that it does not need."""
        super().__init__(config)
        config.validate_features()
        self.config: ChunkedMLPConfig = config
        self.input_keys = [key for key in (OBS_STATE, OBS_ENV_STATE) if key in (config.input_features or {})]
        inputs = sum((config.input_features or {})[key].shape[0] for key in self.input_keys)
        self.image_keys = sorted(config.image_features)
        if self.image_keys:
            self.encoders = nn.ModuleList(
                PictureEncoder(config.image_features[key].shape[0], config) for key in self.image_keys
            )
            inputs += config.cnn_features * len(self.image_keys)
        self.action_dim = (config.output_features or {})[ACTION].shape[0]
        layers: list[nn.Module] = []
        for width in config.hidden_dims:
            layers += [nn.Linear(inputs, width), nn.ReLU(), nn.Dropout(config.dropout)]
            inputs = width
        self.model = nn.Sequential(*layers, nn.Linear(inputs, config.chunk_size * self.action_dim))
        self.reset()

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return the parameters for the optimizer: biases are not decayed."""
        named = list(self.named_parameters())
        return [
            {"params": [p for name, p in named if not name.endswith("bias")]},
            {"params": [p for name, p in named if name.endswith("bias")], "weight_decay": 0.0},
        ]

    def reset(self) -> None:
        """Forget the actions that were predicted but not carried out; call it when the environment is reset."""
        self._queue: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def _predict(self, batch: dict[str, Tensor]) -> Tensor:
        """Map normalised observations (B, D) to normalised actions (B, chunk_size, action_dim)."""
        clip = self.config.input_clip
        parts = [batch[key].clamp(-clip, clip) for key in self.input_keys]
        if self.image_keys:
            parts += [
                encoder(cropped(batch[key], self.config.crop, self.training))
                for key, encoder in zip(self.image_keys, self.encoders, strict=True)
            ]
        return self.model(torch.cat(parts, dim=-1)).unflatten(-1, (self.config.chunk_size, self.action_dim))

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Return the loss.

        Args:
            batch: Normalised observations (B, D), ``action`` (B, chunk_size, A) and, optionally, ``action_is_pad``
                (B, chunk_size) bool.
            reduction: "mean" for one number, "none" for one number a sample, as LeRobot's sample weighting asks for.
        """
        error = (self._predict(batch) - batch[ACTION]).abs().mean(dim=-1)  # (B, chunk_size)
        pad = batch.get("action_is_pad")
        valid = torch.ones_like(error) if pad is None else (~pad).to(error.dtype)
        if reduction == "none":
            per_sample = (error * valid).sum(dim=-1) / valid.sum(dim=-1).clamp_min(1)
            return per_sample, {"l1_loss": per_sample.mean().item()}
        loss = (error * valid).sum() / valid.sum().clamp_min(1)
        return loss, {"l1_loss": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:  # noqa: ANN401
        """Return the chunk (B, chunk_size, action_dim), normalised, for normalised observations (B, D)."""
        self.eval()
        return self._predict(batch)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:  # noqa: ANN401
        """Return the next action (B, action_dim), predicting a new chunk after every ``n_action_steps`` of them."""
        if not self._queue:
            chunk = self.predict_action_chunk(batch)[:, : self.config.n_action_steps]
            self._queue.extend(chunk.transpose(0, 1))
        return self._queue.popleft()
