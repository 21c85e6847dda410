"""rsl_rl's MLP model -> one that is exactly mirror-symmetric, so that every sample teaches both sides.

output(x) = (net(x) + mirror(net(mirror(x)))) / 2, with a normaliser that sees both. Unlike augmenting the batch with
mirrored samples, the KL estimate, and with it the adaptive learning rate, stays right.
"""

from typing import Any, cast

import torch
import torch.distributed as dist
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict

from gym_demohlm.control import features
from gym_demohlm.wbc.training.mdp import CRITIC_MIRROR


class MirrorModel(MLPModel):
    """A symmetric actor (with a distribution) or critic (without).

    Args:
        obs, obs_groups, obs_set, output_dim, kwargs: As in rsl_rl.
        symmetric: False gives the plain network, to see what the symmetry is worth.

    Attributes:
        symmetric: The same.
    """

    _seen_source: torch.Tensor
    _seen_sign: torch.Tensor
    _out_source: torch.Tensor
    _out_sign: torch.Tensor

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        symmetric: bool = True,
        **kwargs: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(obs, obs_groups, obs_set, output_dim, **kwargs)
        self._samples: list[torch.Tensor] = []
        self.symmetric = symmetric
        seen = features.OBSERVATION_MIRROR if obs_set == "actor" else CRITIC_MIRROR
        self.register_buffer("_seen_source", torch.as_tensor(seen[0]))
        self.register_buffer("_seen_sign", torch.as_tensor(seen[1]))
        out = features.ACTION_MIRROR if obs_set == "actor" else ([0], [1.0])
        self.register_buffer("_out_source", torch.as_tensor(out[0]))
        self.register_buffer("_out_sign", torch.as_tensor(out[1], dtype=torch.float32))
        if obs_set == "actor":
            with torch.no_grad():
                last = cast(torch.nn.Linear, self.mlp[-1])
                last.weight.mul_(0.05)  # start at the reference
                last.bias.zero_()

    def _mirrored(self, values: torch.Tensor) -> torch.Tensor:
        return values[..., self._seen_source] * self._seen_sign

    def _observed(self, obs: TensorDict) -> torch.Tensor:
        return torch.cat([obs[group] for group in self.obs_groups], dim=-1)

    def forward(
        self,
        obs: TensorDict,
        masks: torch.Tensor | None = None,
        hidden_state: Any = None,  # noqa: ANN401
        stochastic_output: bool = False,
    ) -> torch.Tensor:
        """Return the mean of the action, a sample of it, or the value; arguments as in rsl_rl."""
        latent = self.obs_normalizer(self._observed(obs)).clamp(-6.0, 6.0)
        if self.symmetric:
            plain, mirrored = self.mlp(torch.cat([latent, self._mirrored(latent)])).chunk(2)
            output = 0.5 * (plain + mirrored[..., self._out_source] * self._out_sign)
        else:
            output = self.mlp(latent)
        if self.distribution is None:
            return output
        if stochastic_output:
            self.distribution.update(output)
            return self.distribution.sample()
        return self.distribution.deterministic_output(output)

    def update_normalization(self, obs: TensorDict) -> None:
        """Keep a part of the samples for ``renew_normalization``."""
        if self.obs_normalization:
            self._samples.append(self._observed(obs)[::4])

    def renew_normalization(self) -> None:
        """Feed the normaliser the kept samples of all processes, and their mirror images."""
        seen = torch.cat(self._samples)
        self._samples.clear()
        if dist.is_initialized():
            parts = [torch.empty_like(seen) for _ in range(dist.get_world_size())]
            dist.all_gather(parts, seen)
            seen = torch.cat(parts)
        cast(EmpiricalNormalization, self.obs_normalizer).update(torch.cat([seen, self._mirrored(seen)]))


class BoundedPPO(PPO):
    """rsl_rl's PPO with bounds on its adaptive learning rate: far below 1e-4 training on two cores stalls.

    Args:
        lowest_learning_rate: Lower bound.
        highest_learning_rate: Upper bound.
    """

    def __init__(
        self,
        *args: Any,  # noqa: ANN401
        lowest_learning_rate: float = 2e-4,
        highest_learning_rate: float = 1e-3,
        **kwargs: Any,  # noqa: ANN401
    ) -> None:
        self._bounds = lowest_learning_rate, highest_learning_rate
        super().__init__(*args, **kwargs)

    @property
    def learning_rate(self) -> float:
        """The current learning rate."""
        return self._learning_rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        low, high = self._bounds
        self._learning_rate = min(max(value, low), high)
