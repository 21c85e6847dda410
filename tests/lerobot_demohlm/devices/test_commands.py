"""LeRobot's own commands with our devices, as processes."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from tests.helpers.lerobot import run

pytestmark = pytest.mark.slow


def test_record_then_train_and_replay(tmp_path: Path) -> None:
    root = tmp_path / "recorded"
    of_dataset = ["--dataset.repo_id=local/recorded", f"--dataset.root={root}"]
    run(
        tmp_path, "lerobot-record", "--robot.type=demohlm_g1", "--teleop.type=demohlm_script", *of_dataset,
        "--dataset.single_task=Lift the box", "--dataset.num_episodes=2", "--dataset.fps=10",
        "--dataset.episode_time_s=2", "--dataset.reset_time_s=0.5", "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )  # fmt: skip
    table = pq.read_table(root / "data")
    episodes = np.array(table["episode_index"])
    states, actions = np.array(table["observation.state"].to_pylist()), np.array(table["action"].to_pylist())
    assert states.shape[1] == len(observation.STATE_NAMES) and actions.shape[1] == command.SIZE
    assert set(episodes.tolist()) == {0, 1}
    first = [states[episodes == episode][0] for episode in (0, 1)]
    home = states[:, :29][episodes == 0][0]
    assert np.abs(first[1][:29] - home).max() < 0.1  # it stood at a start again
    assert np.abs(actions[episodes == 1][-1, command.ARMS] - command.rest()[command.ARMS]).max() > 0.05
    run(
        tmp_path, "lerobot-train", *of_dataset, "--policy.type=chunked_mlp", "--policy.device=cpu",
        "--policy.push_to_hub=false", f"--output_dir={tmp_path / 'trained'}", "--steps=2", "--batch_size=4",
        "--num_workers=0", "--save_checkpoint=false",
    )  # fmt: skip
    run(
        tmp_path, "lerobot-replay", "--robot.type=demohlm_g1", *of_dataset, "--dataset.episode=1", "--play_sounds=false"
    )


def test_teleoperate(tmp_path: Path) -> None:
    run(
        tmp_path, "lerobot-teleoperate", "--robot.type=demohlm_g1", "--robot.task=GraspCube",
        "--teleop.type=demohlm_web", "--teleop.port=0", "--teleop_time_s=2",
    )  # fmt: skip
