"""The wheel holds everything, and works in an empty environment outside the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from lerobot_demohlm.datasets import writer
from tests.helpers.paths import REPOSITORY
from tests.helpers.synthetic import make_episode

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

PACKAGES = ("gym_demohlm", "lerobot_demohlm", "lerobot_env_demohlm")
UV = next(  # the one of this Python first: a shim on the path may depend on the folder
    (
        found
        for found in (os.environ.get("UV"), shutil.which("uv", path=f"{sys.base_prefix}/bin"), shutil.which("uv"))
        if found
    ),
    None,
)


def run(*words: str | Path, cwd: Path) -> str:
    """Run a command outside the checkout and return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run([str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{words[0]}: {done.stderr[-3000:]}"
    return done.stdout


def uv(*words: str | Path, cwd: Path) -> str:
    """Run uv."""
    if UV is None:
        pytest.skip("uv is not installed")
    return run(UV, *words, cwd=cwd)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the sdist of the checkout and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    uv("build", "--quiet", "--python", sys.executable, "--out-dir", folder, REPOSITORY, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the commands' folder of an environment that holds the wheel and what it needs, at the versions here."""
    folder = tmp_path_factory.mktemp("installed")
    frozen = uv("pip", "freeze", "--quiet", "--exclude-editable", "--python", sys.executable, cwd=folder)
    (folder / "versions.txt").write_text(frozen)
    uv("venv", "--quiet", "--python", sys.executable, folder / "venv", cwd=folder)
    (wheel,) = built.glob("*.whl")
    python = folder / "venv/bin/python"
    uv("pip", "install", "--quiet", "--python", python, "--constraint", folder / "versions.txt", wheel, cwd=folder)
    return folder / "venv/bin"


def test_every_file_of_the_packages_is_in_sdist_and_wheel(built: Path) -> None:
    names = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert {Path(name).suffix for name in names} >= {".py", ".json", ".j2", ".parquet", ".npz"}
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        assert set(names) - set(archive.namelist()) == set()
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert set(names) - held == set()


def test_an_environment_is_made(installed: Path, tmp_path: Path) -> None:
    code = (
        "import gymnasium, gym_demohlm, numpy\n"
        "env = gymnasium.make('DemoHLM/LiftBox-v0')\n"
        "observation, info = env.reset(seed=0)\n"
        "env.step(env.action_space.sample() * 0)\n"
        "print(gym_demohlm.__file__)"
    )
    place = Path(run(installed / "python", "-c", code, cwd=tmp_path).splitlines()[-1])
    assert place.is_relative_to(installed.parent)


def test_a_packaged_demonstration_is_replayed(installed: Path, tmp_path: Path) -> None:
    assert "ticks replayed" in run(installed / "demohlm", "replay", "--task", "LiftBox", cwd=tmp_path)


def test_a_policy_is_trained_and_evaluated(installed: Path, tmp_path: Path) -> None:
    writer.write_dataset(tmp_path / "data", "local/data", [make_episode(index) for index in range(3)])
    env = ("--env.type=demohlm", "--env.task=LiftBox-v0", "--env.region=R1")
    run(
        installed / "lerobot-train",
        *("--policy.type=chunked_mlp", "--policy.push_to_hub=false", "--policy.device=cpu"),
        *("--policy.hidden_dims=[16]", "--dataset.repo_id=local/data", f"--dataset.root={tmp_path / 'data'}"),
        *(*env, f"--output_dir={tmp_path / 'out'}", "--steps=2", "--env_eval_freq=0", "--num_workers=0"),
        cwd=tmp_path,
    )
    run(
        installed / "lerobot-eval",
        *(f"--policy.path={tmp_path / 'out/checkpoints/last/pretrained_model'}", "--policy.device=cpu", *env),
        *("--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}"),
        cwd=tmp_path,
    )
    content = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert content["overall"]["n_episodes"] == 1
