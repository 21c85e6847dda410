"""``demohlm train-controller``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from gym_demohlm.errors import SceneError
from gym_demohlm.wbc.training.train_config import TrainConfig, cpu_config, cuda_config
from lerobot_demohlm.cli.parsing import default

_CPU_PROCESSES = 2


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm train-controller``.

    Attributes:
        output: Folder of the run.
        hours: Wall-clock time of training.
        seed: Seed of commands, randomisation and exploration.
        device: Physics and learning on the CPU (mujoco.rollout) or on a GPU (mujoco_warp).
        num_processes: With --device cpu, processes that share 512 worlds, one a core.
        resume: Go on from the last checkpoint.
        polish: Learn slowly and explore little, for the last part of a run, with --resume. Not with --warm-start, after
            which a run does so anyway.
        noise: Standard deviation of exploring actions, held from the second iteration on; half of it in the hip-yaw
            joints.
        max_steps: Control steps of the whole run after which it ends.
        evaluate_every: Iterations between evaluations.
        warm_start: Exported weights that the actor goes on from. The critic begins afresh.
        warm_up: Iterations in which that critic learns alone.
        gait: JSON file with settings of the walking reference.
        physics: Of the robot: the first version, or the second with self-collision, dry friction and peak torques.
        reward: Other weights of terms of the reward, as NAME=WEIGHT.
        without: Leave one part of the training out, to see what it is worth. "critic" is what the critic alone sees.
    """

    output: Path = Path("runs/controller")
    hours: float = 3.0
    seed: int = TrainConfig.seed
    device: Literal["cpu", "cuda"] = "cpu"
    num_processes: Annotated[int | None, default(str(_CPU_PROCESSES))] = None
    resume: bool = False
    polish: bool = False
    noise: Annotated[float | None, default("learned, at most 0.12 with --polish or --warm-start")] = None
    max_steps: Annotated[int | None, default("no end")] = None
    evaluate_every: int = TrainConfig.evaluate_every
    warm_start: Annotated[Path | None, default("nothing")] = None
    warm_up: int = TrainConfig.warm_up
    gait: Annotated[Path | None, default("the first controller's")] = None
    physics: Literal["first", "second"] = "first"
    reward: Annotated[tuple[str, ...], default("the weights of rewards.py")] = ()
    without: Annotated[
        Literal["symmetry", "reference", "curriculum", "loads", "pushes", "critic"] | None, default("nothing")
    ] = None


def run(options: Options) -> None:
    """Train the controller."""
    from gym_demohlm.control.settings import read_gait
    from gym_demohlm.robot.physics import named
    from gym_demohlm.wbc.training import rewards
    from gym_demohlm.wbc.training.train import POLISHING_NOISE, train

    if not options.hours > 0:
        raise SceneError(f"hours={options.hours:g}", "more than 0", "correct --hours")
    config = (
        cuda_config()
        if options.device == "cuda"
        else cpu_config(_CPU_PROCESSES if options.num_processes is None else options.num_processes)
    )
    config = replace(
        config,
        mdp=replace(
            config.mdp,
            use_reference=options.without != "reference",
            pushed_share=0.0 if options.without == "pushes" else config.mdp.pushed_share,
            largest_load=0.0 if options.without == "loads" else config.mdp.largest_load,
            critic_knows=options.without != "critic",
            gait=read_gait(options.gait) if options.gait else config.mdp.gait,
            physics=named(options.physics),
            reward_table=rewards.with_weights(dict(rewards.parse(text) for text in options.reward)),
        ),
        num_processes=config.num_processes if options.num_processes is None else options.num_processes,
        polish=options.polish,
        largest_noise=POLISHING_NOISE if options.polish or options.warm_start else config.largest_noise,
        held_noise=options.noise,
        warm_start=options.warm_start,
        warm_up=options.warm_up,
        symmetric=options.without != "symmetry",
        curriculum=options.without != "curriculum",
        evaluate_every=options.evaluate_every,
        max_steps=options.max_steps,
        seed=options.seed,
    )
    train(options.output, config, hours=options.hours, resume=options.resume)
