"""The MDP -> a trained controller: rsl_rl's PPO on two CPU cores, with checkpoints and a curriculum.

``demohlm train-controller --hours 2 --output runs/controller`` trains; ``--resume`` goes on from the last checkpoint.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from gym_demohlm.control import features
from gym_demohlm.errors import SceneError
from gym_demohlm.wbc.export import export_weights
from gym_demohlm.wbc.mdp import MdpConfig, WholeBodyMdp

STEPS_PER_ITERATION = 24
LEVEL_STEP, LEVEL_EVERY = 0.08, 20  # the curriculum rises by 0.08 every 20 iterations ...
LEVEL_TICKS_BETWEEN_FALLS = 1200  # ... while a robot falls less often than this


class MdpVecEnv(VecEnv):
    """The NumPy MDP behind rsl_rl's interface; restarts ended episodes and raises the curriculum."""

    def __init__(self, config: MdpConfig) -> None:
        self.mdp = WholeBodyMdp(config)
        self.num_envs = config.num_worlds
        self.num_actions = features.ACTION_SIZE
        self.max_episode_length = config.episode_ticks
        self.episode_length_buf = torch.zeros(config.num_worlds, dtype=torch.long)
        self.device = "cpu"
        self.cfg = config
        self.ticks, self.falls = 0, 0

    def get_observations(self) -> TensorDict:
        """Return the observation groups ``actor`` and ``critic``."""
        actor, critic = self.mdp.observe()
        groups = {"actor": torch.from_numpy(actor), "critic": torch.from_numpy(critic)}
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all worlds by a control tick and restart those that ended."""
        reward, fell, ended = self.mdp.step(actions.numpy().astype(np.float64))
        worlds = np.nonzero(ended)[0]
        self.ticks += self.num_envs
        self.falls += int(fell.sum())
        self.mdp.reset(worlds)
        extras = {"time_outs": torch.from_numpy((ended & ~fell).astype(np.float32))}
        return (
            self.get_observations(),
            torch.from_numpy(reward.astype(np.float32)),
            torch.from_numpy(ended.astype(np.int64)),
            extras,
        )


def ppo_config(seed: int, *, polish: bool = False) -> dict[str, Any]:
    """Return the rsl_rl configuration of a run.

    Args:
        seed: Of exploration.
        polish: Learn slowly and stop exploring, for the last minutes: the mean action, which is what runs on the
            robot, gets steadier.
    """
    network = {
        "class_name": "gym_demohlm.wbc.mirror_model:MirrorModel",
        "hidden_dims": [256, 128, 64],
        "activation": "elu",
        "obs_normalization": True,
    }
    noise = {"class_name": "GaussianDistribution", "init_std": float(np.exp(-1.0)), "std_type": "log"}
    return {
        "seed": seed,
        "num_steps_per_env": STEPS_PER_ITERATION,
        "save_interval": 10**9,
        "check_for_nan": False,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {**network, "distribution_cfg": noise},
        "critic": dict(network),
        "algorithm": {
            "class_name": "gym_demohlm.wbc.mirror_model:BoundedPPO",
            "num_learning_epochs": 3,
            "num_mini_batches": 4,
            "gamma": 0.98,
            "lam": 0.95,
            "clip_param": 0.2,
            "value_loss_coef": 0.5,
            "use_clipped_value_loss": False,
            "entropy_coef": -0.002 if polish else 0.003,
            "learning_rate": 1e-4 if polish else 1e-3,
            "lowest_learning_rate": 5e-5 if polish else 2e-4,
            "highest_learning_rate": 2e-4 if polish else 1e-3,
            "desired_kl": 0.01 if polish else 0.02,
            "schedule": "adaptive",
            "rnd_cfg": None,
            "symmetry_cfg": None,
        },
    }


def train(
    output: Path, *, hours: float, seed: int = 1, resume: bool = False, polish: bool = False, **size: int
) -> None:
    """Train for a while, writing ``checkpoint.pt``, ``weights.npz`` and ``log.jsonl`` every 50 iterations.

    Args:
        output: Folder of the run.
        hours: Wall-clock time.
        seed: Of commands, randomisation, exploration.
        resume: Go on from ``checkpoint.pt``.
        polish: See ``ppo_config``.
        size: ``num_worlds``, ``num_variants`` or ``num_threads`` other than those of ``MdpConfig``.

    Raises:
        SceneError: ``resume`` without a checkpoint, or a run that exists already without ``resume``.
    """
    checkpoint = output / "checkpoint.pt"
    if resume != checkpoint.exists():
        got = "no checkpoint" if resume else "a run that exists already"
        raise SceneError(f"{got} in {output}", "a fresh folder, or a run to resume", "change --output or --resume")
    output.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(seed)
    env = MdpVecEnv(MdpConfig(seed=seed, **size))
    runner = OnPolicyRunner(env, ppo_config(seed, polish=polish), log_dir=str(output / "tensorboard"), device="cpu")
    progress = {"steps": 0, "seconds": 0.0, "level": 0.0, "iteration": 0}
    if resume:
        progress = _load(runner, checkpoint)
        env.mdp.level = progress["level"]
    runner.alg.train_mode()
    runner.logger.init_logging_writer()
    start = time.monotonic() - progress["seconds"]
    end = time.monotonic() + 3600 * hours
    while time.monotonic() < end:
        statistics = _iterate(runner, env)
        progress["iteration"] += 1
        progress["steps"] += STEPS_PER_ITERATION * env.num_envs
        progress["seconds"] = time.monotonic() - start
        _clamp_noise(runner)
        if progress["iteration"] % LEVEL_EVERY == 0:
            between_falls = env.ticks / max(env.falls, 1)
            env.ticks = env.falls = 0
            if between_falls > LEVEL_TICKS_BETWEEN_FALLS:
                env.mdp.level = min(1.0, env.mdp.level + LEVEL_STEP)
            progress["level"] = env.mdp.level
            _log(output, runner, {**progress, "ticks_between_falls": between_falls, **statistics})
        if progress["iteration"] % 50 == 0:
            _save(runner, env, output, progress)
    _save(runner, env, output, progress)
    torch.set_flush_denormal(False)  # of this process, whatever it does next


def _iterate(runner: OnPolicyRunner, env: MdpVecEnv) -> dict[str, float]:
    """Collect one batch and learn from it; the loop of rsl_rl's runner without its bookkeeping."""
    rewards = []
    began = time.monotonic()
    with torch.inference_mode():
        seen = env.get_observations()
        for _ in range(STEPS_PER_ITERATION):
            seen, reward, ended, extras = env.step(runner.alg.act(seen))
            runner.alg.process_env_step(seen, reward, ended, extras)
            rewards.append(float(reward.mean()))
        runner.alg.compute_returns(seen)
    collected = time.monotonic()
    losses = runner.alg.update()
    tracking = {f"error/{name}": value for name, value in env.mdp.tracking.items()}
    terms = {f"reward/{name}": value for name, value in env.mdp.terms.items()}
    return {
        "reward": float(np.mean(rewards)),
        "collect_s": collected - began,
        "learn_s": time.monotonic() - collected,
        "learning_rate": runner.alg.learning_rate,
        "noise": float(_log_noise(runner).detach().exp().mean()),
        **{f"loss/{name}": float(value) for name, value in losses.items()},
        **tracking,
        **terms,
    }


def _log_noise(runner: OnPolicyRunner) -> torch.Tensor:
    return cast(Any, runner.alg.actor.distribution).log_std_param


def _clamp_noise(runner: OnPolicyRunner) -> None:
    with torch.no_grad():
        _log_noise(runner).clamp_(-2.5, 0.0)


def _log(output: Path, runner: OnPolicyRunner, values: dict[str, float]) -> None:
    with (output / "log.jsonl").open("a") as file:
        file.write(json.dumps({name: round(value, 5) for name, value in values.items()}) + "\n")
    if runner.logger.writer is not None:
        for name, value in values.items():
            runner.logger.writer.add_scalar(name, value, int(values["steps"]))
    errors = " ".join(f"{name[6:]} {value:.3f}" for name, value in values.items() if name.startswith("error/"))
    print(
        f"{values['steps'] / 1e6:.2f} M steps, {values['seconds'] / 60:.1f} min, level {values['level']:.2f}, "
        f"{values['ticks_between_falls']:.0f} ticks between falls, reward {values['reward']:.3f}, "
        f"noise {values['noise']:.2f}, "
        f"rate {values['learning_rate']:.1e}, {values['collect_s']:.2f} + {values['learn_s']:.2f} s | {errors}",
        flush=True,
    )


def _save(runner: OnPolicyRunner, env: MdpVecEnv, output: Path, progress: dict[str, float]) -> None:
    partial = output / "checkpoint.partial"
    torch.save({**runner.alg.save(), "progress": progress}, partial)
    partial.replace(output / "checkpoint.pt")
    facts = {"training_command": "demohlm train-controller", **progress}
    export_weights(runner.alg.get_policy(), env.mdp.reference.shift_table, output / "weights.npz", facts)


def _load(runner: OnPolicyRunner, checkpoint: Path) -> dict[str, float]:
    saved = torch.load(checkpoint, weights_only=True)
    runner.alg.load(saved, None, True)
    return saved["progress"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm train-controller``."""
    parser.add_argument("--output", type=Path, default=Path("runs/controller"), help="folder of the run")
    parser.add_argument("--hours", type=float, default=2.0, help="wall-clock time of training")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--num-threads", type=int, default=2, help="threads of the physics")
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    parser.add_argument("--polish", action="store_true", help="learn slowly, without exploring: the last part of a run")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm train-controller``."""
    train(
        arguments.output,
        hours=arguments.hours,
        seed=arguments.seed,
        resume=arguments.resume,
        polish=arguments.polish,
        num_threads=arguments.num_threads,
    )


if __name__ == "__main__":
    _parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(_parser)
    main(_parser.parse_args())
