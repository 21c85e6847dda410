"""One demonstration to a LeRobot dataset, opened again: generate a few episodes and look at them.

Run: ``uv run python examples/generate_and_look.py [DIRECTORY]``
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_demohlm.generation.runner import GenerationRequest, generate


def main(directory: Path, num_attempts: int = 8) -> None:
    """Generate attempts of LiftBox in R1 and print what is in the dataset."""
    request = GenerationRequest(task="LiftBox", region="R1", seed=0, root=directory, num_attempts=num_attempts)
    summary = generate(request)
    print(f"{summary.successes} of {summary.attempts} attempts succeeded: {summary.outcomes}")

    dataset = LeRobotDataset("local/lift_box", root=directory)
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames at {dataset.fps} Hz")
    for name, feature in dataset.meta.features.items():
        print(f"  {name}: {feature['dtype']} {tuple(feature['shape'])}")
    frame = dataset[0]
    print(f"task: {frame['task']!r}")
    action = dataset.meta.features["action"]["names"]
    for name, value in zip(action, np.asarray(frame["action"]), strict=True):
        print(f"  {name} = {value:.3f}")
    facts = json.loads((directory / "meta" / "demohlm.json").read_text())
    print("made by", facts["versions"])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("outputs/lift_box"))
