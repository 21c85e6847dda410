"""A dataset to a scored policy, by LeRobot's own commands: train the chunked MLP, then evaluate it.

Run: ``uv run python examples/train_and_evaluate.py DATASET [DIRECTORY] [STEPS]``
"""

import subprocess
import sys
from pathlib import Path

PROGRAMS = Path(sys.executable).parent  # those of this Python, also where its environment is not activated


def main(dataset: Path, directory: Path, steps: int = 2000, episodes: int = 10) -> None:
    """Train on a dataset of LiftBox, then score the last checkpoint on new initial states."""
    subprocess.run(
        [
            PROGRAMS / "lerobot-train",
            "--policy.type=chunked_mlp",
            "--policy.device=cpu",
            "--policy.push_to_hub=false",
            f"--dataset.repo_id=local/{dataset.name}",
            f"--dataset.root={dataset}",
            f"--output_dir={directory / 'train'}",
            f"--steps={steps}",
            f"--save_freq={steps}",
            "--batch_size=512",
            "--num_workers=0",
            "--env_eval_freq=0",
        ],
        check=True,
    )
    checkpoint = directory / "train" / "checkpoints" / "last" / "pretrained_model"
    subprocess.run(
        [
            PROGRAMS / "lerobot-eval",
            f"--policy.path={checkpoint}",
            "--policy.device=cpu",
            "--env.type=demohlm",
            "--env.task=LiftBox-v0",
            "--env.region=R1",
            f"--eval.n_episodes={episodes}",
            f"--eval.batch_size={episodes}",
            f"--output_dir={directory / 'eval'}",
        ],
        check=True,
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    _directory = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("outputs/train_and_evaluate")
    main(Path(sys.argv[1]), _directory, *(int(number) for number in sys.argv[3:4]))
