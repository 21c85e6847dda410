"""The MDP in NumPy -> the environment in torch that rsl_rl learns from."""

from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from gym_demohlm.control import features
from gym_demohlm.wbc.training.mdp import MdpConfig, WholeBodyMdp


class MdpVecEnv(VecEnv):
    """The NumPy MDP behind rsl_rl's interface; restarts ended episodes and counts falls.

    Attributes:
        tally: Ticks and falls of the worlds left alone, ticks and falls of those pushed, since the last reset of it.
    """

    def __init__(self, config: MdpConfig, device: str = "cpu") -> None:
        self.mdp = WholeBodyMdp(config)
        self.num_envs = config.num_worlds
        self.num_actions = features.ACTION_SIZE
        self.max_episode_length = config.episode_ticks
        self.episode_length_buf = torch.zeros(config.num_worlds, dtype=torch.long, device=device)
        self.device = device
        self.cfg = config
        self.tally = np.zeros(4)

    def get_observations(self) -> TensorDict:
        """Return the observation groups ``actor`` and ``critic``."""
        actor, critic = self.mdp.observe()
        groups = {"actor": self._tensor(actor), "critic": self._tensor(critic)}
        return TensorDict(groups, batch_size=[self.num_envs])

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all worlds by a control tick and restart those that ended."""
        reward, fell, ended = self.mdp.step(actions.cpu().numpy().astype(np.float64))
        pushed = self.mdp.pushed
        self.tally += [(~pushed).sum(), fell[~pushed].sum(), pushed.sum(), fell[pushed].sum()]
        self.mdp.reset(np.nonzero(ended)[0])
        extras = {"time_outs": self._tensor((ended & ~fell).astype(np.float32))}
        return (
            self.get_observations(),
            self._tensor(reward.astype(np.float32)),
            self._tensor(ended.astype(np.int64)),
            extras,
        )
