"""What is written after a verb reaches what does the work, which is not done here."""

import importlib
import inspect
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from gym_demohlm.control import controllers
from gym_demohlm.control.settings import read_gait
from gym_demohlm.robot.physics import named
from gym_demohlm.task import Task
from gym_demohlm.wbc.evaluation.trial_commands import CommandRange
from gym_demohlm.wbc.training.train import POLISHING_NOISE
from gym_demohlm.wbc.training.train_config import cpu_config, cuda_config
from lerobot_demohlm import cli

WEIGHTS = controllers.find("default")
SIZE = {"num_worlds": 6, "seconds": 1.5, "seed": 7, "num_threads": 3}
SIZED = "--num-worlds 6 --seconds 1.5 --seed 7 --num-threads 3"
PARTS = "lerobot_demohlm.benchmarks."
CONTROLLER = "gym_demohlm.wbc.evaluation."
TRAIN = "gym_demohlm.wbc.training.train.train"


class ReachedError(Exception):
    """What does the work was called."""


def reach(monkeypatch: pytest.MonkeyPatch, line: str, function: str) -> dict[str, Any]:
    """Return the arguments, by name, with which a call of ``demohlm`` comes to a function; tasks as their names."""
    module, _, name = function.rpartition(".")
    original = getattr(importlib.import_module(module), name)
    given: dict[str, Any] = {}

    def note(*arguments: Any, **options: Any) -> None:
        given.update(inspect.signature(original).bind(*arguments, **options).arguments)
        raise ReachedError

    with monkeypatch.context() as patch, pytest.raises(ReachedError):
        patch.setattr(f"{module}.{name}", note)
        cli.main(line.split())
    if "tasks" in given:
        given["tasks"] = [task.name for task in given["tasks"]]
    if isinstance(given.get("task"), Task):
        given["task"] = given["task"].name
    return given


@pytest.mark.parametrize(("line", "function", "expected"), [
    (
        "benchmark --task PushCube --region R2 --num-attempts 3 --rounds 5", "suite.measure",
        {"task": "PushCube", "region": "R2", "num_attempts": 3, "rounds": 5},
    ),
    (
        "benchmark simulation --task PushCube --num-worlds 3 --num-threads 2 --controller other", "simulation.measure",
        {"task": "PushCube", "num_worlds": 3, "num_threads": 2, "controller": "other"},
    ),
    (
        "benchmark generation --task PushCube --region R2 --seed 4 --num-attempts 3 --demonstration d --controller c",
        "generation.measure",
        {"task": "PushCube", "region": "R2", "seed": 4, "num_attempts": 3, "demonstration": Path("d"),
         "controller": "c"},
    ),
    ("benchmark dataset --rounds 3 --run-episodes 0", "dataset.measure_speed", {"rounds": 3}),
    ("benchmark dataset --run-episodes 7", "dataset.measure_memory", {"num_episodes": 7}),
    (
        "benchmark loading --root d --chunk 3 --batch-size 4 --rounds 5 --batches 6", "loading.measure",
        {"root": Path("d"), "chunk": 3, "batch_size": 4, "rounds": 5, "batches": 6},
    ),
    (
        "benchmark training --root d --policies act --preset paper --steps 8", "training.measure",
        {"root": Path("d"), "policy": "act", "preset": "paper", "steps": 8},
    ),
    (
        "benchmark teleoperation --task PushCube --seconds 2 --browser --iwer i.js", "teleoperation.measure",
        {"task": "PushCube", "seconds": 2.0, "browser": True, "iwer": Path("i.js")},
    ),
    (
        "benchmark perturbed --tasks PushCube --first 3 --num-operators 2 --num-attempts 4 --num-trial 5 --region R2 "
        "--append a.jsonl --root r",
        "perturbed.measure",
        {"tasks": ["PushCube"], "operators": range(3, 5), "attempts": 4, "append": Path("a.jsonl"), "root": Path("r"),
         "region": "R2", "trial": 5},
    ),
    (
        "benchmark feedback --tasks PushCube --variations real --replays ours --num-attempts 3 --region R2 --results r",
        "feedback.measure",
        {"tasks": ["PushCube"], "variations": ("real",), "replays": ("ours",), "attempts": 3,
         "path": Path("r/feedback.jsonl"), "region": "R2"},
    ),
    (
        "benchmark variation --tasks PushCube --variations real --num-attempts 3 --region R2 --results r",
        "variation.measure",
        {"tasks": ["PushCube"], "variations": ("real",), "attempts": 3, "path": Path("r/variation.jsonl"),
         "region": "R2"},
    ),
    ("benchmark deployment --seconds 3", "deployment.measure_link", {"seconds": 3.0}),
    (
        "benchmark deployment --part success --policy p --task PushCube --region R2 --pose-source rgbd --seed 5 "
        "--num-runs 3 --domain 9",
        "deployment_success.measure_success",
        {"task": "PushCube", "policy": Path("p"), "region": "R2", "seeds": range(5, 8), "source": "rgbd", "domain": 9,
         "known": []},
    ),
    ("benchmark perception --axes bias_mm --results r --figure f.png", "perception_curves.draw",
     {"lines": Path("r/perception_curves.jsonl"), "figure": Path("f.png")}),
])  # fmt: skip
def test_benchmarks_get_what_is_asked(
    line: str, function: str, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert reach(monkeypatch, line, PARTS + function) == expected


WIDE = CommandRange(roll=(-0.2, 0.2), yaw=(-0.3, 0.3))
DRAWN = f"{SIZED} --roll 0.2 --yaw 0.3 --hand-load 0.5"


@pytest.mark.parametrize(("line", "function", "expected"), [
    (
        f"{DRAWN} --num-seeds 2", "benchmark.benchmark",
        {**SIZE, "ranges": WIDE, "weights": WEIGHTS, "num_seeds": 2, "largest_hand_load": 0.5},
    ),
    (
        f"{DRAWN} --velocity-only", "benchmark.benchmark",
        {**SIZE, "ranges": WIDE.velocity_only(), "weights": WEIGHTS, "num_seeds": 3, "largest_hand_load": 0.5},
    ),
    (f"robustness {SIZED}", "benchmark.robustness", SIZE),
    (
        f"peer {DRAWN} --name holosoma-ppo --own-range", "peer.benchmark",
        {"name": "holosoma-ppo", **SIZE, "ranges": WIDE, "largest_hand_load": 0.5, "own_range": True},
    ),
    (
        f"paired {SIZED} --controllers a b --protocol arms --physics second --num-seeds 2", "contest.contest",
        {"names": ("a", "b"), "protocol": "arms", **SIZE, "num_seeds": 2, "physics": "second"},
    ),
    (
        f"ablation {SIZED} --controller a --parts velocity-map --num-seeds 2", "contest.ablate",
        {"name": "a", "parts": ("velocity-map",), **SIZE, "num_seeds": 2},
    ),
    (f"trade-off {SIZED} --root r", "trade_off.trade_off", {**SIZE, "weights": WEIGHTS}),
    (
        "figures --root r --run runs/a --seed 7 --num-threads 3", "figures.draw",
        {"folder": Path("r"), "weights": WEIGHTS, "run": Path("runs/a"), "seed": 7, "num_threads": 3},
    ),
    (
        "compare --root . --runs a b", "figures.draw_comparison",
        {"runs": (Path("a"), Path("b")), "path": Path("controller_comparison.png")},
    ),
])  # fmt: skip
def test_benchmarks_of_the_controller_get_what_is_asked(
    line: str, function: str, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert reach(monkeypatch, f"benchmark controller {line}", CONTROLLER + function) == expected


def test_the_reach_of_the_palms_is_measured_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    line = "benchmark reach --output r.png --num-worlds 6 --rounds 2 --step 0.3 --seed 7 --num-threads 3"
    found = reach(monkeypatch, line, f"{CONTROLLER}trial.trial_simulation")
    assert found == {"num_worlds": 6, "num_threads": 3, "weights": WEIGHTS}
    monkeypatch.setattr(f"{CONTROLLER}trial.trial_simulation", lambda *_, **__: "worlds")
    found = reach(monkeypatch, line, f"{CONTROLLER}reach.hand_error")
    assert found == {"simulation": "worlds", "seed": 7, "rounds": 2}
    monkeypatch.setattr(f"{CONTROLLER}reach.hand_error", lambda *_: {})
    found = reach(monkeypatch, line, f"{CONTROLLER}reach.measure_map")
    assert found == {"simulation": "worlds", "step": 0.3, "path": Path("r.png")}


def test_a_pose_server_listens_where_it_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gym_demohlm.perception.pose_server.make_backend", lambda name: f"backend {name}")
    line = "pose-server --backend tracker --address tcp://127.0.0.1:5571"
    found = reach(monkeypatch, line, "gym_demohlm.perception.pose_server.serve")
    found.pop("ready")("tcp://here")
    assert found == {"backend": "backend tracker", "address": "tcp://127.0.0.1:5571"}
    assert capsys.readouterr().out == "tracker listens at tcp://here\n"


@pytest.mark.parametrize(("options", "where", "value"), [
    ("--seed 7", "seed", 7),
    ("--num-processes 3", "num_processes", 3),
    ("--polish", "polish", True),
    ("--polish", "largest_noise", POLISHING_NOISE),
    ("--noise 0.2", "held_noise", 0.2),
    ("--max-steps 9", "max_steps", 9),
    ("--evaluate-every 8", "evaluate_every", 8),
    ("--warm-start w.npz", "warm_start", Path("w.npz")),
    ("--warm-start w.npz", "largest_noise", POLISHING_NOISE),
    ("--warm-up 6", "warm_up", 6),
    ("--physics second", "mdp.physics.name", "second"),
    ("--without symmetry", "symmetric", False),
    ("--without curriculum", "curriculum", False),
    ("--without reference", "mdp.use_reference", False),
    ("--without loads", "mdp.largest_load", 0.0),
    ("--without pushes", "mdp.pushed_share", 0.0),
    ("--without critic", "mdp.critic_knows", False),
])  # fmt: skip
def test_a_training_of_the_controller_is_set_as_asked(
    options: str, where: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = attrgetter(where)
    plain, found = (reach(monkeypatch, f"train-controller {given}", TRAIN)["config"] for given in ("", options))
    assert read(found) == value != read(plain)


def test_a_training_of_the_controller_goes_where_and_on_what_it_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plain = reach(monkeypatch, "train-controller", TRAIN)
    first = replace(cpu_config(2), mdp=replace(cpu_config(2).mdp, physics=named("first")))
    assert plain == {"output": Path("runs/controller"), "config": first, "hours": 3.0, "resume": False}
    found = reach(monkeypatch, "train-controller --output o --hours 0.5 --resume --device cuda", TRAIN)
    assert found.pop("config").mdp.warp_device == cuda_config().mdp.warp_device != first.mdp.warp_device
    assert found == {"output": Path("o"), "hours": 0.5, "resume": True}
    (tmp_path / "gait.json").write_text('{"lift": 0.07}')
    line = f"train-controller --gait {tmp_path / 'gait.json'} --reward power=-0.5 slip=0"
    changed = reach(monkeypatch, line, TRAIN)["config"].mdp
    assert changed.gait == read_gait(tmp_path / "gait.json") != first.mdp.gait
    weights = {name: term.weight for name, term in changed.reward_table.items()}
    before = {name: term.weight for name, term in first.mdp.reward_table.items()}
    assert weights == before | {"power": -0.5, "slip": 0.0}
