"""The MDP -> a trained controller: rsl_rl's PPO on CPU cores or a GPU, with checkpoints and curricula.

``demohlm train-controller --hours 3 --output runs/controller`` trains; ``--resume`` goes on from the last checkpoint.
On CPU cores every process steps its own worlds and learns from them; gradients are averaged, so that all stay equal.
With ``--device cuda`` one process steps many more worlds and learns from them on the GPU.
"""

import json
import os
import pickle
import shutil
import signal
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.distributed as dist
from rsl_rl.runners import OnPolicyRunner
from torch.multiprocessing.spawn import ProcessContext, ProcessRaisedException, start_processes

from gym_demohlm import jsonl
from gym_demohlm.control import features
from gym_demohlm.control.whole_body import read_arrays
from gym_demohlm.errors import DemoHLMError, SceneError
from gym_demohlm.files import replace_text, replacing
from gym_demohlm.wbc.training.export import export_weights, import_weights
from gym_demohlm.wbc.training.mirror_model import MirrorModel
from gym_demohlm.wbc.training.train_config import TrainConfig, ppo_config
from gym_demohlm.wbc.training.vec_env import MdpVecEnv

_SMALLEST_LOG_NOISE = -2.5
POLISHING_NOISE = 0.12
_ERROR = "error"  # file in which a process tells the others' parent what it raised
_QUIET_JOINTS = np.array([0.5 if "hip_yaw" in joint else 1.0 for joint in features.DRIVEN_JOINTS])  # share of the noise
_FREE = (  # what may differ where a run is resumed
    *("mdp", "num_worlds", "num_threads", "warp_device", "num_processes", "device"),
    *("max_steps", "save_every", "evaluate_every", "keep_every"),
)
_LATER = ("polish", "largest_noise", "held_noise")  # what may, and is kept in changes.jsonl
_CRITIC_RATE = 1e-3  # learning rate of a critic that begins after the actor


@dataclass
class Progress:
    """Where a run is; kept in its checkpoint."""

    steps: int = 0
    seconds: float = 0.0
    iteration: int = 0
    level: float = 0.0
    push_level: float = 0.0


def train(output: Path, config: TrainConfig, *, hours: float, resume: bool = False) -> None:
    """Train for a while, writing ``checkpoint.pt``, ``weights.npz`` and ``log.jsonl``; SIGTERM and Ctrl-C save first.

    A run that comes to its end calibrates its last weights; one that is stopped leaves ``calibrated.npz`` as it was.

    Args:
        output: Folder of the run.
        config: Of the run.
        hours: Wall-clock time.
        resume: Go on from ``checkpoint.pt``. Processes, device, the end and how often it is saved may be others, and
            so may exploration and polish, which ``changes.jsonl`` keeps.

    Raises:
        SceneError: ``resume`` without a checkpoint or with another configuration, a run that exists already without
            ``resume``, or weights to start from that cannot be read.
    """
    checkpoint = output / "checkpoint.pt"
    if resume != checkpoint.exists():
        got = "no checkpoint" if resume else "a run that exists already"
        raise SceneError(f"{got} in {output}", "a fresh folder, or a run to resume", "change --output or --resume")
    if config.warm_start is not None and not resume:
        read_arrays(config.warm_start)  # here, where an error has cost nothing yet
    output.mkdir(parents=True, exist_ok=True)
    _keep(output, config, resume)
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        ended = _start(output, config, hours)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if ended:
        _calibrate(output)


def _keep(output: Path, config: TrainConfig, resume: bool) -> None:
    """Write what decides a training, and what a resumed one changes; runs of earlier versions have no such file.

    Raises:
        SceneError: A run is resumed with what may not be another.
    """
    path = output / "config.json"
    rewards = {name: (term.weight, term.scale) for name, term in config.mdp.reward_table.items()}
    content = {**vars(config.mdp), **vars(config), "reward_table": rewards}
    now = {name: str(value) for name, value in content.items() if name not in _FREE}
    if resume and path.exists():
        try:
            then = json.loads(path.read_text())
        except ValueError as error:
            raise SceneError(
                f"{path}, damaged ({error})", "what the run began with", "remove it to resume with these options"
            ) from error
        changed = [name for name in sorted(then.keys() | now.keys()) if then.get(name) != now.get(name)]
        for name in changed:
            if name not in _LATER:
                raise SceneError(
                    f"a run in {output} that began with {name}={then.get(name)}",
                    f"{now.get(name)}, as asked for now",
                    "resume it with the same options, or choose another --output",
                )
        if changed:
            progress = torch.load(output / "checkpoint.pt", weights_only=True, map_location="cpu")["progress"]
            values = {name: [then.get(name), now[name]] for name in changed}
            jsonl.append(output / "changes.jsonl", [{"steps": progress["steps"], **values}])
    replace_text(path, json.dumps(now, indent=2) + "\n")


def _start(output: Path, config: TrainConfig, hours: float) -> bool:
    """Train in this process or in several; returns whether the run came to its end, rather than being stopped.

    Raises:
        DemoHLMError: As it was raised in one of them.
    """
    stopping: list[int] = []
    if config.num_processes == 1:
        try:
            _work(0, output, config, hours, "", stopping)
        finally:
            torch.set_flush_denormal(False)  # of this process, whatever it does next
        return not stopping
    with tempfile.TemporaryDirectory() as meeting:
        context = cast(
            ProcessContext,
            start_processes(
                _join, (output, config, hours, meeting), config.num_processes, join=False, start_method="spawn"
            ),
        )

        def stop(received: int, _: object) -> None:
            stopping.append(received)
            for pid in context.pids():
                os.kill(cast(int, pid), signal.SIGTERM)

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        try:
            while not context.join():
                pass
        except ProcessRaisedException:
            error = Path(meeting) / _ERROR
            if not error.exists():
                raise
            raise pickle.loads(error.read_bytes()) from None
    return not stopping


def _join(rank: int, output: Path, config: TrainConfig, hours: float, meeting: str) -> None:
    """Be one of several processes; an error that a user can cause is left in the folder where they meet."""
    try:
        _work(rank, output, config, hours, f"file://{meeting}/store", [])
    except DemoHLMError as error:
        beside = Path(meeting) / f"{_ERROR}.{rank}"
        beside.write_bytes(pickle.dumps(error))
        beside.replace(Path(meeting) / _ERROR)
        raise


def _work(rank: int, output: Path, config: TrainConfig, hours: float, meeting: str, stopping: list[int]) -> None:
    """Be one of the processes; rank 0 writes, and ``stopping`` gets the signals that are received."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    path, saved = output / "checkpoint.pt", None
    if path.exists():
        saved = torch.load(path, weights_only=True, map_location=config.device)
    progress = Progress() if saved is None else Progress(**saved["progress"])
    seed = _seed(config.seed, rank, progress.iteration)
    torch.manual_seed(seed)
    if meeting:
        dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=config.num_processes)
    env = MdpVecEnv(replace(config.mdp, seed=seed), config.device)
    log_dir = str(output / "tensorboard") if rank == 0 else None
    runner = OnPolicyRunner(env, ppo_config(config), log_dir=log_dir, device=config.device)
    runner.alg.is_multi_gpu = bool(meeting)  # rsl_rl's name for averaging gradients among processes
    runner.alg.gpu_global_rank, runner.alg.gpu_world_size = rank, config.num_processes
    if saved is not None:
        runner.alg.load(saved, None, True)
    else:
        if config.warm_start is not None:
            import_weights(runner.alg.get_policy(), config.warm_start)
        if meeting:
            runner.alg.broadcast_parameters()
    if not config.curriculum or config.warm_start is not None:
        progress.level = progress.push_level = 1.0
    env.mdp.level, env.mdp.push_level = progress.level, progress.push_level
    runner.alg.train_mode()
    if rank == 0:
        runner.logger.init_logging_writer()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda received, _: stopping.append(received))
    start = time.monotonic() - progress.seconds
    end = time.monotonic() + 3600 * hours
    most_steps = np.inf if config.max_steps is None else config.max_steps
    while not _any(bool(stopping) or time.monotonic() > end) and progress.steps < most_steps:
        _warm_up(runner, config, progress.iteration)
        statistics = _iterate(runner, env, config)
        if config.warm_start is not None and progress.iteration == 0:
            _set_value(runner, statistics["reward"])
        progress.iteration += 1
        progress.steps += config.steps_per_iteration * env.num_envs * config.num_processes
        progress.seconds = time.monotonic() - start
        if progress.iteration % config.level_every == 0:
            statistics |= _raise_levels(env, progress, config)
            if rank == 0:
                _log(output, runner, {**vars(progress), **statistics})
        evaluates = progress.iteration % config.evaluate_every == 0
        if rank == 0 and (evaluates or progress.iteration % config.save_every == 0):
            _save(runner, env, output, progress, config)
        if rank == 0 and evaluates:
            _evaluate(output, runner, progress)
    if rank == 0:
        _save(runner, env, output, progress, config)
    if meeting:
        dist.destroy_process_group()


def _seed(seed: int, rank: int, iteration: int) -> int:
    """Return the seed of a process, which a resumed run does not share with its beginning."""
    if iteration == 0:
        return seed + 1000 * rank
    return int(np.random.SeedSequence([seed, rank, iteration]).generate_state(1)[0])


def _warm_up(runner: OnPolicyRunner, config: TrainConfig, iteration: int) -> None:
    """Let the critic alone learn, quickly, in the first iterations after a warm start."""
    if config.warm_start is None or iteration > config.warm_up:
        return
    critic_alone = iteration < config.warm_up
    runner.alg.get_policy().requires_grad_(not critic_alone)
    rate = _CRITIC_RATE if critic_alone else config.warm_rate
    runner.alg.learning_rate = rate
    for group in runner.alg.optimizer.param_groups:
        group["lr"] = rate  # whatever the bounds of the adaptive one


def _set_value(runner: OnPolicyRunner, reward: float) -> None:
    """Let a fresh critic begin at the value of a reward that goes on for ever, which it is slow to climb to."""
    mean = torch.tensor(reward)
    if dist.is_initialized():
        dist.all_reduce(mean)
        mean /= dist.get_world_size()
    with torch.no_grad():
        cast(Any, runner.alg.critic).mlp[-1].bias.fill_(float(mean) / (1 - runner.alg.gamma))


def _any(flag: bool) -> bool:
    """Return whether the flag is set in any process."""
    if not dist.is_initialized():
        return flag
    value = torch.tensor(float(flag))
    dist.all_reduce(value, op=dist.ReduceOp.MAX)
    return bool(value)


def _raise_levels(env: MdpVecEnv, progress: Progress, config: TrainConfig) -> dict[str, float]:
    """Raise the curricula that robots have mastered, and start a new tally."""
    tally = torch.from_numpy(env.tally.copy())
    if dist.is_initialized():
        dist.all_reduce(tally)
    env.tally[:] = 0
    between, between_pushed = float(tally[0] / max(tally[1], 1)), float(tally[2] / max(tally[3], 1))
    if between > config.level_ticks:
        progress.level = min(1.0, progress.level + config.level_step)
    if between_pushed > config.push_level_ticks:
        progress.push_level = min(1.0, progress.push_level + config.level_step)
    env.mdp.level, env.mdp.push_level = progress.level, progress.push_level
    return {"ticks_between_falls": between, "ticks_between_falls_pushed": between_pushed}


def _iterate(runner: OnPolicyRunner, env: MdpVecEnv, config: TrainConfig) -> dict[str, float]:
    """Collect one batch and learn from it; the loop of rsl_rl's runner without its bookkeeping."""
    rewards = []
    began = time.monotonic()
    with torch.inference_mode():
        seen = env.get_observations()
        for _ in range(config.steps_per_iteration):
            seen, reward, ended, extras = env.step(runner.alg.act(seen))
            runner.alg.process_env_step(seen, reward, ended, extras)
            rewards.append(float(reward.mean()))
        runner.alg.compute_returns(seen)
    collected = time.monotonic()
    losses = runner.alg.update()
    with torch.inference_mode():
        for model in (runner.alg.actor, runner.alg.critic):
            cast(MirrorModel, model).renew_normalization()
        _bound_noise(_log_noise(runner), config)
    tracking = {f"error/{name}": value for name, value in env.mdp.tracking.items()}
    terms = {f"reward/{name}": value for name, value in env.mdp.terms.items()}
    return {
        "reward": float(np.mean(rewards)),
        "collect_s": collected - began,
        "learn_s": time.monotonic() - collected,
        "learning_rate": runner.alg.learning_rate,
        "noise": float(_log_noise(runner).exp().mean()),
        **{f"loss/{name}": float(value) for name, value in losses.items()},
        **tracking,
        **terms,
    }


def _bound_noise(log_noise: torch.Tensor, config: TrainConfig) -> None:
    """Keep the logarithms (15,) of the standard deviations where the configuration wants them."""
    held = config.held_noise
    largest = torch.from_numpy(np.log((held or config.largest_noise) * _QUIET_JOINTS)).to(log_noise)
    if held is None:
        log_noise.clamp_(_SMALLEST_LOG_NOISE).clamp_(max=largest)
    else:
        log_noise.copy_(largest)


def _log_noise(runner: OnPolicyRunner) -> torch.Tensor:
    return cast(Any, runner.alg.actor.distribution).log_std_param.data


def _log(output: Path, runner: OnPolicyRunner, values: dict[str, float]) -> None:
    with (output / "log.jsonl").open("a") as file:
        file.write(json.dumps({name: round(value, 5) for name, value in values.items()}) + "\n")
    if runner.logger.writer is not None:
        for name, value in values.items():
            runner.logger.writer.add_scalar(name, value, int(values["steps"]))
    errors = " ".join(f"{name[6:]} {value:.3f}" for name, value in values.items() if name.startswith("error/"))
    print(
        f"{values['steps'] / 1e6:.2f} M steps, {values['seconds'] / 60:.1f} min, level {values['level']:.2f}, "
        f"pushes {values['push_level']:.2f}, {values['ticks_between_falls']:.0f} ticks between falls, "
        f"{values['ticks_between_falls_pushed']:.0f} pushed, reward {values['reward']:.3f}, "
        f"noise {values['noise']:.2f}, "
        f"rate {values['learning_rate']:.1e}, {values['collect_s']:.2f} + {values['learn_s']:.2f} s | {errors}",
        flush=True,
    )


def _evaluate(output: Path, runner: OnPolicyRunner, progress: Progress) -> None:
    """Calibrate the saved weights on the deployment model, run a short benchmark of them and log it."""
    from gym_demohlm.wbc.evaluation.benchmark import quick  # the deployment model is not needed to learn

    _calibrate(output)
    found = {f"deployment/{name}": value for name, value in quick(output / "calibrated.npz").items()}
    line = {"steps": progress.steps, "seconds": round(progress.seconds, 1), **found}
    with (output / "evaluation.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")
    print(json.dumps(line), flush=True)
    if runner.logger.writer is not None:
        for name, value in found.items():
            runner.logger.writer.add_scalar(name, value, progress.steps)


def _calibrate(output: Path) -> None:
    """Write ``calibrated.npz`` of the saved weights, unless it is theirs already."""
    from gym_demohlm.wbc.evaluation.calibration import calibrate

    weights, calibrated = output / "weights.npz", output / "calibrated.npz"
    if not calibrated.exists() or _iteration(calibrated) != _iteration(weights):
        calibrate(weights, calibrated)


def _iteration(weights: Path) -> int:
    return read_arrays(weights)[1]["iteration"]


def _save(runner: OnPolicyRunner, env: MdpVecEnv, output: Path, progress: Progress, config: TrainConfig) -> None:
    with replacing(output / "checkpoint.pt") as beside:
        torch.save({**runner.alg.save(), "progress": dict(vars(progress))}, beside)
    facts = {"training_command": "demohlm train-controller", "seed": config.seed, **vars(progress)}
    settings = config.mdp.settings
    export_weights(runner.alg.get_policy(), env.mdp.reference, settings, output / "weights.npz", facts)
    if progress.iteration % config.keep_every == 0:
        shutil.copy(output / "weights.npz", output / f"weights_{progress.steps}.npz")
