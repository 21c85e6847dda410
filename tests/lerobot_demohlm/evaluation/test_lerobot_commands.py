"""``lerobot-train`` and ``lerobot-eval`` as a user types them: plugin found, worlds in one process or one each."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_demohlm.datasets import writer
from tests.helpers.synthetic import make_episode

pytestmark = pytest.mark.slow


def lerobot(command: str, *arguments: str, cwd: Path) -> None:
    """Run one of LeRobot's commands outside the repository."""
    done = subprocess.run(
        [str(Path(sys.executable).parent / command), *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train two steps on random episodes: a policy that soon falls."""
    directory = tmp_path_factory.mktemp("train")
    writer.write_dataset(directory / "data", "local/data", [make_episode(index) for index in range(3)])
    lerobot(
        "lerobot-train",
        "--policy.type=chunked_mlp",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--policy.hidden_dims=[16]",
        "--dataset.repo_id=local/data",
        f"--dataset.root={directory / 'data'}",
        "--env.type=demohlm",
        "--env.task=LiftBox-v0",
        "--env.region=R1",
        f"--output_dir={directory / 'out'}",
        "--steps=2",
        "--env_eval_freq=0",
        "--num_workers=1",
        cwd=directory,
    )
    return directory / "out/checkpoints/last/pretrained_model"


@pytest.mark.parametrize("use_async", ["false", "true"])
def test_train_then_evaluate(checkpoint: Path, tmp_path: Path, use_async: str) -> None:
    lerobot(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        "--env.type=demohlm",
        "--env.task=LiftBox-v0",
        "--env.region=R1",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--eval.use_async_envs={use_async}",
        f"--output_dir={tmp_path / 'eval'}",
        cwd=tmp_path,
    )
    content = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert content["overall"]["n_episodes"] == 2
    assert content["overall"]["pc_success"] == 0.0
    videos = sorted((tmp_path / "eval/videos").rglob("*.mp4"))
    assert len(videos) == 2
    assert all(video.stat().st_size > 1000 for video in videos)
