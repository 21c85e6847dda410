"""How a controller is trained: sizes, curricula, and the configuration that rsl_rl gets."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.wbc.training.mdp import MdpConfig


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a controller is trained.

    Attributes:
        mdp: The worlds of one process.
        num_processes: Processes, one a core; one in all with a GPU.
        device: Of learning, as torch names it.
        steps_per_iteration: Control ticks collected in each world before learning.
        level_step: A curriculum rises by this ...
        level_every: ... every so many iterations ...
        level_ticks: ... while a robot that nobody pushes falls less often than once in so many ticks ...
        push_level_ticks: ... or one that is pushed (the strength of the pushes).
        save_every: Iterations between checkpoints.
        evaluate_every: Iterations between evaluations on the deployment model.
        max_steps: Control steps after which a run ends, if its time has not.
        hidden_sizes: Of actor and critic.
        polish: Learn slowly and explore little, for the last part: the mean action, which is what runs on the robot,
            gets steadier. A warm start does so anyway.
        largest_noise: Bound of the actions' standard deviation.
        held_noise: Their standard deviation instead of a learned one, from the second iteration on: the first explores
            as without it. Half of both in the hip-yaw joints.
        symmetric: Whether actor and critic are mirror-symmetric.
        curriculum: Whether commands and pushes start easy.
        warm_start: Exported weights that the actor starts from, with the whole range, exploring little.
        warm_up: Iterations in which the critic alone learns, after a warm start.
        warm_rate: Learning rate of the iteration after these; adaptive from there.
        keep_every: Iterations between copies of the weights that are kept; a multiple of ``save_every``.
        seed: Of commands, randomisation, exploration.
    """

    mdp: MdpConfig = field(default_factory=MdpConfig)
    num_processes: int = 2
    device: str = "cpu"
    steps_per_iteration: int = 24
    level_step: float = 0.08
    level_every: int = 20
    level_ticks: int = 1200
    push_level_ticks: int = 500
    save_every: int = 50
    evaluate_every: int = 250
    max_steps: int | None = None
    hidden_sizes: tuple[int, ...] = (256, 128, 64)
    polish: bool = False
    largest_noise: float = 1.0
    held_noise: float | None = None
    symmetric: bool = True
    curriculum: bool = True
    warm_start: Path | None = None
    warm_up: int = 40
    warm_rate: float = 1e-4
    keep_every: int = 200
    seed: int = 1

    def __post_init__(self) -> None:
        """Check the device, the noise and the counts.

        Raises:
            SceneError: Several processes with a GPU, a noise that is not positive, a count out of range, or a polish
                with a warm start.
        """
        if self.num_processes < 1 or self.mdp.num_worlds < 1 or self.warm_up < 0 or self._ends_at_once:
            got = (
                f"{self.num_processes} processes of {self.mdp.num_worlds} worlds, warm_up={self.warm_up}, "
                f"max_steps={self.max_steps}"
            )
            raise SceneError(got, "1 or more of each, and a warm-up of 0 or more", "correct the options")
        for name in ("level_every", "save_every", "evaluate_every", "keep_every"):
            if getattr(self, name) < 1:
                raise SceneError(f"{name}={getattr(self, name)}", "1 or more iterations", f"raise {name}")
        if self.held_noise is not None and not 0 < self.held_noise < np.inf:
            raise SceneError(f"a noise of {self.held_noise}", "a positive standard deviation", "pass --noise 0.2")
        if self.polish and self.warm_start is not None:
            expected = "one of them: after a warm start a run learns slowly and explores little anyway"
            raise SceneError("polish with a warm start", expected, "leave out --polish")
        if self.device != "cpu" and self.num_processes != 1:
            got = f"{self.num_processes} processes with device {self.device!r}"
            raise SceneError(got, "one process, whose worlds are stepped together", "leave out --num-processes")

    @property
    def _ends_at_once(self) -> bool:
        return self.max_steps is not None and self.max_steps < 1


def cpu_config(num_processes: int) -> TrainConfig:
    """Return the configuration for CPU cores: 512 worlds on mujoco.rollout, shared among processes."""
    return TrainConfig(mdp=MdpConfig(num_worlds=512 // max(num_processes, 1)), num_processes=num_processes)


def cuda_config() -> TrainConfig:
    """Return the configuration for a GPU: 4096 worlds on mujoco_warp in one process that learns there too."""
    return TrainConfig(mdp=MdpConfig(num_worlds=4096, warp_device="cuda"), num_processes=1, device="cuda")


def ppo_config(config: TrainConfig) -> dict[str, Any]:
    """Return the rsl_rl configuration of a run."""
    network = {
        "class_name": "gym_demohlm.wbc.training.mirror_model:MirrorModel",
        "hidden_dims": list(config.hidden_sizes),
        "activation": "elu",
        "obs_normalization": True,
        "symmetric": config.symmetric,
    }
    warm, polish = config.warm_start is not None, config.polish
    start = config.largest_noise if warm else float(np.exp(-1.0))
    noise = {"class_name": "GaussianDistribution", "init_std": start, "std_type": "log"}
    # After a warm start the deviation is small already, and a KL of 0.01 would hold the rate near 1e-4.
    rates = (2e-4, 3e-5, 1e-3) if warm else (2e-4, 5e-5, 4e-4) if polish else (1e-3, 2e-4, 1e-3)
    return {
        "seed": config.seed,
        "num_steps_per_env": config.steps_per_iteration,
        "save_interval": 10**9,
        "check_for_nan": False,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {**network, "distribution_cfg": noise},
        "critic": dict(network),
        "algorithm": {
            "class_name": "gym_demohlm.wbc.training.mirror_model:BoundedPPO",
            "num_learning_epochs": 3,
            "num_mini_batches": 4,
            "gamma": 0.98,
            "lam": 0.95,
            "clip_param": 0.2,
            "value_loss_coef": 0.5,
            "use_clipped_value_loss": False,
            "entropy_coef": 0.0 if warm else -0.001 if polish else 0.003,
            "learning_rate": rates[0],
            "lowest_learning_rate": rates[1],
            "highest_learning_rate": rates[2],
            "desired_kl": 0.015 if polish or warm else 0.02,
            "schedule": "adaptive",
            "rnd_cfg": None,
            "symmetry_cfg": None,
        },
    }
