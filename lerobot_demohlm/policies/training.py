"""A dataset and a preset -> a trained policy, by LeRobot's own training with its data held in memory.

The checkpoint is an ordinary one of ``lerobot-train``, and ``lerobot-train --config_path=FILE`` with the file that
``--write-config`` writes, or with the ``train_config.json`` of the checkpoint, is the same training, bit for bit with
as many threads (``OMP_NUM_THREADS``); ACT's bits depend on their number.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gym_demohlm.errors import DatasetError
from lerobot_demohlm.datasets.facts import read_info, require_new_root
from lerobot_demohlm.policies.devices import require_device
from lerobot_demohlm.policies.presets import PRESETS, train_config

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

BATCH_SIZE = PRESETS["mlp", "cpu"].batch_size


def checkpoint(root: Path) -> Path:
    """Return where a training leaves its last checkpoint."""
    return root / "checkpoints" / "last" / "pretrained_model"


def train(
    root: Path,
    dataset_root: Path,
    policy: str = "mlp",
    preset: str = "cpu",
    *,
    steps: int | None = None,
    seed: int = 0,
    num_episodes: int | None = None,
    device: str = "cpu",
    num_threads: int = 1,
    batch_size: int | None = None,
    options: Mapping[str, Any] | None = None,
) -> Path:
    """Train a policy and return its last checkpoint.

    Args:
        root: Output directory of the training; must not exist.
        dataset_root: The dataset.
        policy: "mlp", "act" or "diffusion".
        preset: "paper" or "cpu", or one that sees.
        steps: Training steps; the preset's by default.
        seed: Of the weights and of the order of the samples.
        num_episodes: Train on so many episodes from the first on; on all by default.
        device: Where it is trained.
        num_threads: Threads of torch. Two on two cores gain a third; where another process is busy, two are ten times
            slower than one.
        batch_size: Samples a step; the preset's by default.
        options: Fields of the policy's configuration that replace the preset's.

    Raises:
        UnknownNameError: No such policy or preset.
        PolicyError: Fewer than one step or episode, a seed out of range, or a device that is not here.
        DatasetError: The root exists, the dataset lacks a column, or the dataset has fewer episodes.
    """
    require_new_root(root, "--output")
    _require_makeable(root)
    require_device(device)
    config = train_config(
        dataset_root.resolve(),  # from a checkpoint it is looked at again, wherever one stands then
        root,
        policy,
        preset,
        steps=steps,
        seed=seed,
        num_episodes=num_episodes,
        device=device,
        batch_size=batch_size,
        options=options,
    )
    require_episodes(dataset_root, num_episodes)
    run(config, num_threads)
    return checkpoint(root)


def _require_makeable(root: Path) -> None:
    """Raise ``DatasetError`` where a directory cannot be made: a training writes at its end."""
    try:
        root.mkdir(parents=True)
        root.rmdir()
    except OSError as error:
        raise DatasetError(
            f"{root} ({error.strerror})", "a path that can be made", "choose another --output"
        ) from error


def require_episodes(dataset_root: Path, num_episodes: int | None) -> None:
    """Raise ``DatasetError`` where a dataset has fewer episodes than are to be trained on."""
    if num_episodes is None:
        return
    available = read_info(dataset_root)["total_episodes"]
    if num_episodes > available:
        raise DatasetError(f"num_episodes={num_episodes}", f"at most the {available} of {dataset_root}", "lower it")


def run(config: "TrainPipelineConfig", num_threads: int = 1) -> None:
    """Run LeRobot's training on data held in memory."""
    import torch
    from accelerate.state import AcceleratorState
    from lerobot.scripts.lerobot_train import train as lerobot_train

    from lerobot_demohlm.datasets import in_memory

    torch.set_num_threads(num_threads)
    in_memory.install()
    AcceleratorState._reset_state(reset_partial_state=True)  # else a training has the precision of the one before it
    lerobot_train(config)  # type: ignore[call-arg]  # its decorator hides that a configuration may be given


def write_config(path: Path, config: "TrainPipelineConfig") -> None:
    """Write a configuration as ``lerobot-train --config_path=`` reads it."""
    import draccus

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file, draccus.config_type("json"):
        draccus.dump(config, file, indent=4)
