"""Presets -> samples a second of ``lerobot-train``, with data in memory and as LeRobot reads them, in turn."""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from gym_demohlm.errors import DatasetError, PolicyError
from lerobot_demohlm.benchmarks.loading import write_random_dataset
from lerobot_demohlm.datasets.in_memory import SWITCH
from lerobot_demohlm.policies.presets import NAMES, POLICIES, train_config
from lerobot_demohlm.policies.training import write_config

LEROBOT_NUM_WORKERS = 4  # processes that load, by LeRobot's default; what is in memory needs none


def samples_per_s(config: Path, output: Path, in_memory: bool) -> float:
    """Return what ``lerobot-train`` says of the second half of its steps, loading included.

    Args:
        config: Configuration that ``write_config`` wrote, with two log lines.
        output: Directory of the training; must not exist.
        in_memory: Whether the plugin may hold the data in memory.

    Raises:
        PolicyError: The training failed.
    """
    words = [str(Path(sys.executable).parent / "lerobot-train"), f"--config_path={config}", f"--output_dir={output}"]
    words += [] if in_memory else [f"--num_workers={LEROBOT_NUM_WORKERS}"]
    threads = {"OMP_NUM_THREADS": "1"}  # with more, a loader and a training that share cores stop each other
    environment = {**os.environ, **threads, SWITCH: "1" if in_memory else "0"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    found = re.findall(r"smp/s:([0-9.]+)", done.stdout + done.stderr)
    if done.returncode != 0 or len(found) != 2:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise PolicyError(f"lerobot-train that failed ({last})", "two lines of its log", "run it by hand")
    return float(found[-1])


def measure(root: Path, policy: str, preset: str, steps: int) -> dict[str, Any]:
    """Return samples a second of both, and how many times more those from memory are.

    Args:
        root: Dataset without images.
        policy: "mlp", "act" or "diffusion".
        preset: "paper" or "cpu".
        steps: Training steps, two or more, of which the second half counts; an odd one is left out.
    """
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "train.json"
        config = train_config(root, Path(scratch) / "unused", policy, preset, steps=steps // 2 * 2)
        config.log_freq, config.save_checkpoint = steps // 2, False
        write_config(file, config)
        theirs = samples_per_s(file, Path(scratch) / "lerobot", in_memory=False)
        ours = samples_per_s(file, Path(scratch) / "memory", in_memory=True)
    return {
        "policy": policy,
        "preset": preset,
        "batch_size": config.batch_size,
        "steps": config.steps,
        "lerobot_num_workers": LEROBOT_NUM_WORKERS,
        "lerobot_samples_per_s": theirs,
        "samples_per_s": ours,
        "ratio": round(ours / theirs, 2),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm benchmark training``."""
    parser.add_argument("--root", type=Path, help="dataset of `demohlm generate` (default: one of random numbers)")
    parser.add_argument("--num-episodes", type=int, default=100, help="of random numbers (default: %(default)s)")
    parser.add_argument("--policies", nargs="+", default=POLICIES, choices=POLICIES, help="which (default: all)")
    parser.add_argument("--preset", default="cpu", choices=NAMES, help="hyperparameters (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=60, help="the second half counts (default: %(default)s)")


def main(arguments: argparse.Namespace) -> None:
    """Measure; a JSON line a policy on stdout.

    Raises:
        DatasetError: A count is too small.
        PolicyError: A training failed.
    """
    for name, least in (("num_episodes", 1), ("steps", 2)):
        if (value := getattr(arguments, name)) < least:
            raise DatasetError(f"{name}={value}", f"{least} or more", f"correct --{name.replace('_', '-')}")
    with tempfile.TemporaryDirectory() as scratch:
        root = arguments.root
        if root is None:
            root = Path(scratch) / "random"
            write_random_dataset(root, arguments.num_episodes)
        for policy in arguments.policies:
            print(json.dumps(measure(root, policy, arguments.preset, arguments.steps)), flush=True)
