"""Lines of success over the robot's protocol: measured once, read back, and shown as a table."""

from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import gym_demohlm  # noqa: F401
from gym_demohlm import jsonl
from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks import deployment_success
from lerobot_demohlm.benchmarks.deployment_faults import measured_seeds
from lerobot_demohlm.benchmarks.deployment_success import SuccessLine, measure_success, read, table
from lerobot_demohlm.evaluation.loaded_policy import policy_hash
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.records import Mode
from tests.helpers.checkpoints import save_policy
from tests.helpers.paths import REPOSITORY

LINE = SuccessLine(
    task="LiftBox", region="R1", source="exact", policy="0123456789ab", first_seed=5, episodes=10, successes=9,
    in_process=10,
)  # fmt: skip


def test_the_table_adds_up_the_lines_of_one_policy() -> None:
    others = [replace(LINE, first_seed=15, successes=10), replace(LINE, source="rgbd"), replace(LINE, policy="f" * 12)]
    assert table([LINE, *others]).splitlines()[2:] == [
        "| LiftBox | R1 | `exact` | 20 | 95 (76 to 99) | 100 (84 to 100) |",
        "| LiftBox | R1 | `rgbd` | 10 | 90 (60 to 98) | 100 (72 to 100) |",
        "| LiftBox | R1 | `exact` | 10 | 90 (60 to 98) | 100 (72 to 100) |",
    ]


def test_what_is_there_is_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lines.jsonl"
    jsonl.append(path, [{"part": "link", "seconds": 1.0}, {"part": "success", "task": "LiftBox", "successes": 12}])
    jsonl.append(path, [{"part": "success", **asdict(LINE), "load": 1.0}])
    assert read(path) == [LINE]
    sessions: list[list[int]] = []

    def over_the_protocol(
        task: str, policy: Path, region: str, seeds: range, source: str, domain: int
    ) -> dict[str, Any]:
        sessions.append(list(seeds))
        return {"successes": len(seeds) - 1}

    def in_process(loaded: object, task: str, region: str, seeds: range, source: str) -> dict[str, Any]:
        return {"in_process": len(seeds)}

    monkeypatch.setattr(deployment_success, "load_policy", lambda path, task: SimpleNamespace(hash=LINE.policy + "ff"))
    monkeypatch.setattr(deployment_success, "_over_the_protocol", over_the_protocol)
    monkeypatch.setattr(deployment_success, "_in_process", in_process)
    for line in measure_success("LiftBox", tmp_path, "R1", range(5, 29), "exact", known=read(path)):
        jsonl.append(path, [line])
    assert sessions == [list(range(15, 25)), list(range(25, 29))]
    assert sum(line.episodes for line in read(path)) == 24
    assert sum(line.successes for line in read(path)) == 9 + 9 + 3


@pytest.mark.parametrize("region", ["R1", "R3"])
def test_a_seed_is_the_same_start_in_one_process_and_on_the_simulated_robot(region: str) -> None:
    env = gym.make("DemoHLM/LiftBox-v0", region=region)
    for seed in (0, 970_001):
        _, info = env.reset(seed=seed)
        assert info["initial_state"] == get_task("LiftBox").sample(region, np.random.default_rng(seed))
    env.close()


def test_the_documented_table_is_that_of_the_results() -> None:
    text = (REPOSITORY / "docs/deployment.md").read_text()
    shown = text.partition("<!-- success -->")[2].partition("<!-- /success -->")[0]
    assert shown.strip() == table(read(REPOSITORY / "results/deployment.jsonl"))


@pytest.mark.parametrize("mode", [Mode.DAMP, Mode.STAND])
def test_a_robot_that_damps_before_it_runs_fails_its_start_alone(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise RobotError("DAMP: control slept", "RUN", "see what holds it back")

    monkeypatch.setattr(deployment_success, "stand_and_run", refused)
    deployment: Any = SimpleNamespace(mode=mode)
    robot: Any = SimpleNamespace()
    with nullcontext() if mode == Mode.DAMP else pytest.raises(RobotError, match="control slept"):
        deployment_success._stand_and_run(deployment, robot)


def test_faults_are_measured_again_for_another_task_or_policy(tmp_path: Path) -> None:
    one, other = save_policy(tmp_path / "one"), save_policy(tmp_path / "other", scale=0.1)
    of = {"part": "faults", "policy": policy_hash(one)[:12]}
    lines = [{**of, "task": "LiftBox", "seed": 3}, {**of, "task": "GraspCube", "seed": 4}, {"part": "link"}]
    assert measured_seeds(lines, "LiftBox", one) == {3}
    assert measured_seeds(lines, "GraspCube-v0", one) == {4}
    assert measured_seeds(lines, "LiftBox", other) == set()
