"""The shipped controller on the deployment model stands, walks where it is told, squats and bends; training runs."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.control.whole_body import DEFAULT_WEIGHTS, Weights, WholeBodyController
from gym_demohlm.errors import SceneError
from gym_demohlm.simulation import Simulation
from gym_demohlm.wbc.evaluation import benchmark, calibration


def _drive(change: dict[int, float], seconds: float) -> tuple[Simulation, np.ndarray]:
    """Hold one command; returns the simulation and how far the pelvis moved (2,) [m]."""
    simulation = Simulation(benchmark.BENCHMARK_TASK)
    start = simulation.pose("pelvis")[0, :2, 3]
    action = command.rest()
    for index, value in change.items():
        action[index] = value
    for _ in range(round(10 * seconds)):
        simulation.step(action[None])
        assert not simulation.fallen()[0]
    return simulation, simulation.pose("pelvis")[0, :2, 3] - start


def test_it_stands_still() -> None:
    simulation, moved = _drive({}, 4.0)
    before = simulation.joint_positions.copy()
    simulation.step(command.rest()[None])
    assert np.abs(simulation.joint_positions - before).max() < 0.02  # rad in 0.1 s: no trembling
    assert np.hypot(*moved) < 0.1


@pytest.mark.parametrize(("axis", "speed"), [(0, 0.4), (0, -0.2), (1, 0.2), (1, -0.2)])
def test_it_walks_where_it_is_told(axis: int, speed: float) -> None:
    _, moved = _drive({axis: speed}, 5.0)
    assert moved[axis] / 5.0 == pytest.approx(speed, abs=0.12)
    assert abs(moved[1 - axis]) / 5.0 < 0.12


@pytest.mark.parametrize(("height", "pitch"), [(0.60, 0.0), (0.55, 0.5), (0.5, 0.8)])
def test_it_squats_and_bends(height: float, pitch: float) -> None:
    simulation, _ = _drive({command.HEIGHT: height, command.PITCH: pitch}, 4.0)
    up = simulation.pose("torso")[0, 2, :3]
    assert simulation.pose("pelvis")[0, 2, 3] == pytest.approx(height, abs=0.03)
    assert np.arctan2(-up[0], np.hypot(up[1], up[2])) == pytest.approx(pitch, abs=0.1)


def test_benchmark_reports_every_number() -> None:
    found = benchmark.benchmark(num_worlds=2, seconds=8.0, seed=1, num_threads=1)
    text = json.loads(json.dumps(found))
    for name in ("linear_velocity_error", "yaw_rate_error", "height_error", "torso_pitch_error", "survival"):
        assert np.isfinite(text[name])
    assert 0.0 <= text["survival"] <= 1.0


@pytest.fixture
def copying(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibration copies the weights: robots that fall are slow to simulate."""
    monkeypatch.setattr(calibration, "calibrate", shutil.copy)


@pytest.mark.usefixtures("copying")
@pytest.mark.parametrize("num_processes", [1, 2])
def test_training_runs_and_resumes(tmp_path: Path, num_processes: int) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import MdpConfig, TrainConfig

    mdp = MdpConfig(num_worlds=8, num_variants=1)
    config = TrainConfig(mdp=mdp, num_processes=num_processes, save_every=1, level_every=1)
    train.train(tmp_path / "run", config, hours=2 / 3600)
    lines = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["steps"] == len(lines) * 24 * 8 * num_processes
    for name in ("weights.npz", "calibrated.npz"):
        assert Weights(tmp_path / "run" / name).metadata["iteration"] == len(lines)
    with pytest.raises(train.SceneError, match="exists already"):
        train.train(tmp_path / "run", config, hours=1 / 3600)
    with pytest.raises(train.SceneError, match="began with symmetric=True; expected False"):
        train.train(tmp_path / "run", replace(config, symmetric=False), hours=1 / 3600, resume=True)
    train.train(tmp_path / "run", config, hours=1 / 3600, resume=True)
    more = (tmp_path / "run" / "log.jsonl").read_text()
    assert json.loads(more.splitlines()[-1])["iteration"] > len(lines)
    if num_processes == 1:  # it has made more steps than these
        train.train(tmp_path / "run", replace(config, max_steps=1), hours=1.0, resume=True)
        assert (tmp_path / "run" / "log.jsonl").read_text() == more


@pytest.mark.usefixtures("copying")
def test_a_start_that_failed_is_corrected(tmp_path: Path) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import MdpConfig, TrainConfig

    mdp = MdpConfig(num_worlds=8, num_variants=1)
    config = TrainConfig(mdp=mdp, hidden_sizes=(16, 16), num_processes=1, max_steps=1, warm_start=tmp_path / "none.npz")
    with pytest.raises(SceneError, match="weights none"):
        train.train(tmp_path / "run", config, hours=1.0)
    assert not (tmp_path / "run").exists()
    with pytest.raises(SceneError, match="weights of 4 layers; expected 3"):
        train.train(tmp_path / "run", replace(config, warm_start=DEFAULT_WEIGHTS), hours=1.0)
    train.train(tmp_path / "run", replace(config, warm_start=None), hours=1.0)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["warm_start"] == "None"


def test_an_error_in_another_process_is_raised_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import TrainConfig

    def work(*_: object) -> None:
        raise SceneError("a wrong file", "a right one", "pass it")

    def start(function: Callable, arguments: tuple, *_: object, **__: object) -> SimpleNamespace:
        def join() -> bool:
            with pytest.raises(SceneError):
                function(1, *arguments)
            raise train.ProcessRaisedException("Traceback ...", 1, 0)

        return SimpleNamespace(join=join, pids=list)

    monkeypatch.setattr(train, "_work", work)
    monkeypatch.setattr(train, "start_processes", start)
    with pytest.raises(SceneError, match="got a wrong file; expected a right one; pass it"):
        train.train(tmp_path / "run", TrainConfig(num_processes=2), hours=1.0)


@pytest.mark.usefixtures("copying")
def test_the_last_part_of_a_run_is_polished(tmp_path: Path) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import MdpConfig, TrainConfig

    steps = 24 * 8
    config = TrainConfig(mdp=MdpConfig(num_worlds=8, num_variants=1), num_processes=1, level_every=1, max_steps=steps)
    train.train(tmp_path, config, hours=1.0)
    polished = replace(config, polish=True, largest_noise=0.12, max_steps=2 * steps)
    train.train(tmp_path, polished, hours=1.0, resume=True)
    first, last = (json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines())
    assert first["noise"] > 0.3 and last["noise"] < 0.121
    assert last["learning_rate"] <= 4e-4
    assert json.loads((tmp_path / "changes.jsonl").read_text()) == {
        "steps": steps,
        "largest_noise": ["1.0", "0.12"],
        "polish": ["False", "True"],
    }
    train.train(tmp_path, polished, hours=1.0, resume=True)
    assert len((tmp_path / "changes.jsonl").read_text().splitlines()) == 1


def test_a_resumed_training_draws_other_numbers() -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    seeds = [train._seed(1, rank, iteration) for rank in range(3) for iteration in (0, 1, 50, 51)]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(
    "changes",
    [
        {"num_processes": 0},
        {"warm_up": -5},
        {"max_steps": 0},
        {"held_noise": 0.0},
        {"held_noise": float("inf")},
        {"evaluate_every": 0},
        {"polish": True, "warm_start": DEFAULT_WEIGHTS},
    ],
)
def test_impossible_trainings_are_refused(changes: dict) -> None:
    from gym_demohlm.wbc.training.train_config import TrainConfig

    with pytest.raises(SceneError):
        TrainConfig(**changes)


def test_a_first_evaluation_finds_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import MdpConfig, TrainConfig

    def quick(path: Path) -> dict[str, float]:
        return {"iteration": WholeBodyController(1, path).weights.metadata["iteration"]}

    monkeypatch.setattr(benchmark, "quick", quick)
    monkeypatch.setattr(calibration, "_NUM_ROBOTS", 4)  # robots that fall are slow to simulate
    mdp = MdpConfig(num_worlds=8, num_variants=1)
    config = TrainConfig(mdp=mdp, num_processes=1, save_every=1000, evaluate_every=1, max_steps=2 * 24 * 8)
    train.train(tmp_path / "run", config, hours=1.0)
    lines = (tmp_path / "run" / "evaluation.jsonl").read_text().splitlines()
    assert [json.loads(line)["deployment/iteration"] for line in lines] == [1, 2]


def test_calibration_maps_the_velocity_of_robots_that_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_NUM_ROBOTS", 32)
    calibration.calibrate(DEFAULT_WEIGHTS, tmp_path / "calibrated.npz")
    found = Weights(tmp_path / "calibrated.npz").settings
    assert found.gain[:2] == (1.0, 1.0)
    assert found.velocity_map and np.isfinite(found.velocity_map).all()
    assert [path.name for path in tmp_path.iterdir()] == ["calibrated.npz"]


@pytest.mark.usefixtures("copying")
def test_exploration_can_be_held(tmp_path: Path) -> None:
    train = pytest.importorskip("gym_demohlm.wbc.training.train")
    from gym_demohlm.wbc.training.train_config import MdpConfig, TrainConfig

    mdp = MdpConfig(num_worlds=8, num_variants=1)
    config = TrainConfig(mdp=mdp, num_processes=1, level_every=1, held_noise=0.2, max_steps=2 * 24 * 8)
    train.train(tmp_path / "run", config, hours=1.0)
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["noise"] for line in lines] == pytest.approx([0.2 * 14 / 15] * 2, abs=1e-4)  # half in two of 15 joints
    with pytest.raises(train.SceneError, match="noise"):
        replace(config, held_noise=0.0)


@pytest.mark.slow
def test_it_keeps_the_promised_errors() -> None:
    found = benchmark.benchmark(num_worlds=64, seconds=20.0, seed=3)
    assert found["linear_velocity_error"] < 0.12
    assert found["yaw_rate_error"] < 0.25
    assert found["height_error"] < 0.03
    assert found["torso_pitch_error"] < 0.06
    assert found["survival"] > 0.9


def test_coming_to_a_stand_does_not_turn_it() -> None:
    """The soles of a robot that stands nearly upright stay where they were put, and so does its heading."""
    told = np.tile(command.rest(), (6, 1))
    told[:, :2] = [[0.05, 0.0], [0.1, 0.0], [0.3, 0.0], [-0.2, 0.0], [0.0, 0.2], [0.0, -0.2]]
    simulation = Simulation(benchmark.BENCHMARK_TASK, num_worlds=len(told))
    simulation.reset([simulation.task.default_state()] * len(told))
    headings = []
    for step in range(55):
        simulation.step(told if step < 30 else np.tile(command.rest(), (len(told), 1)))
        headings.append(np.arctan2(*simulation.pose("pelvis")[:, [1, 0], 0].T))
    swaying = np.mean(headings[30:37], axis=0)  # a gait period, in which it squares up its feet
    assert np.abs(headings[-1] - swaying).max() < 0.035
