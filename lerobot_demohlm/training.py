"""A state-only dataset -> a trained chunked MLP: LeRobot's own training with its data held in memory.

The checkpoint is an ordinary one of ``lerobot-train``, which trains the same from disk, at the pace of its loader.
"""

import argparse
from pathlib import Path

from gym_demohlm.errors import PolicyError
from lerobot_demohlm.dataset import read_facts, require_new_root

BATCH_SIZE = 512  # the paper's
LEARNING_RATE = 5e-4
"""Ten times the paper's, falling to zero: 5e-5 would need some hours for what these few minutes must do."""


def train(root: Path, dataset_root: Path, *, steps: int, seed: int) -> Path:
    """Train the chunked MLP with LeRobot's own training, its data held in memory, and return the checkpoint.

    Args:
        root: Output directory of the training; must not exist.
        dataset_root: Dataset without images.
        steps: Steps of ``BATCH_SIZE`` samples.
        seed: Of the weights and of the order of the samples.
    """
    import torch
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.scripts.lerobot_train import train as lerobot_train

    from lerobot_demohlm.loading import in_memory_batches
    from lerobot_demohlm.policies.chunked_mlp import ChunkedMLPConfig

    config = TrainPipelineConfig(
        dataset=DatasetConfig(repo_id=f"local/{dataset_root.name}", root=str(dataset_root)),
        policy=ChunkedMLPConfig(
            device="cpu", push_to_hub=False, optimizer_lr=LEARNING_RATE, scheduler_warmup_steps=max(1, steps // 20)
        ),
        output_dir=root,
        steps=steps,
        batch_size=BATCH_SIZE,
        num_workers=0,
        save_freq=steps,
        env_eval_freq=0,
        log_freq=0,
        seed=seed,
    )
    torch.set_num_threads(1)  # two would gain a third; where another process is busy, they are ten times slower
    with in_memory_batches():
        lerobot_train(config)  # type: ignore[call-arg]  # its decorator hides that a configuration may be given
    return root / "checkpoints" / "last" / "pretrained_model"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm train``."""
    parser.add_argument("--root", type=Path, required=True, help="dataset of `demohlm generate`")
    parser.add_argument("--output", type=Path, required=True, help="directory of the training; must not exist")
    parser.add_argument("--steps", type=int, default=8000, help=f"training steps of {BATCH_SIZE} samples")
    parser.add_argument("--seed", type=int, default=0, help="of the weights and of the order of the samples")


def main(arguments: argparse.Namespace) -> None:
    """Run ``demohlm train``; the last line on stdout is the path of the checkpoint.

    Raises:
        DatasetError: There is no dataset, or the output exists.
        PolicyError: Fewer than one step.
    """
    if arguments.steps < 1:
        raise PolicyError(f"steps={arguments.steps}", "1 or more", "correct --steps")
    read_facts(arguments.root)
    require_new_root(arguments.output)
    print(train(arguments.output, arguments.root, steps=arguments.steps, seed=arguments.seed))
