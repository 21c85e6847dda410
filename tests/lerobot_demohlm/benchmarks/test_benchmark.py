"""Benchmarks: what they compare is equal, and their last line is one JSON object; LeRobot's statistics, bit for bit."""

import json

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from lerobot.datasets.compute_stats import get_feature_stats

from gym_demohlm.registry import all_tasks
from gym_demohlm.scene import build_scene
from gym_demohlm.simulation import Simulation
from lerobot_demohlm import cli
from lerobot_demohlm.benchmarks import dataset
from lerobot_demohlm.benchmarks.stopwatch import Stopwatch
from lerobot_demohlm.datasets.statistics import episode_stats
from lerobot_demohlm.demonstrations import demonstration as demonstrations

NUMBERS = st.one_of(st.floats(-1e3, 1e3, width=32), st.sampled_from([0.0, 1.0, 1000.0, 1e-7]))
COLUMNS = st.one_of(
    arrays.arrays(np.float32, st.tuples(st.integers(1, 60), st.integers(1, 4)), elements=NUMBERS),
    arrays.arrays(np.int64, st.integers(1, 60), elements=st.integers(-1000, 1000)),
    arrays.arrays(np.bool_, st.integers(1, 60)),
)


@settings(max_examples=60, deadline=None)
@given(values=COLUMNS)
def test_statistics_are_lerobots_bit_for_bit(values: np.ndarray) -> None:
    expected = get_feature_stats(values, axis=0, keepdims=values.ndim == 1)
    found = episode_stats({"column": values})["column"]
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert found[name].shape == value.shape
        np.testing.assert_array_equal(found[name].astype(np.float64), value.astype(np.float64), err_msg=name)


def test_statistics_of_long_walks_are_lerobots_bit_for_bit() -> None:
    walks = np.random.default_rng(0).normal(size=(333, 20)).cumsum(axis=0).astype(np.float32) + 100.0
    expected, found = get_feature_stats(walks, axis=0, keepdims=False), episode_stats({"walks": walks})["walks"]
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name].astype(np.float64), value.astype(np.float64), err_msg=name)


@pytest.mark.parametrize("name", all_tasks())
def test_a_step_without_what_is_only_seen_has_the_same_bits(name: str) -> None:
    scene = build_scene(all_tasks()[name])
    assert scene.physics.nmesh == 0
    qpos, mocap_pos, mocap_quat = scene.place({"robot": [-0.3, 0.0, 0.1], "object": [0.02, -0.03, 0.1]})
    ends = []
    for model in (scene.model, scene.physics):
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, mocap_pos, mocap_quat
        data.ctrl[: len(scene.body_qpos)] = qpos[scene.body_qpos]
        mujoco.mj_step(model, data, nstep=100)
        ends.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
    assert ends[0].tobytes() == ends[1].tobytes()


def test_the_no_slip_pass_is_for_rubber_palms_that_touch_an_object() -> None:
    for name, iterations in (("LiftBox", 2), ("GraspCube", 0)):
        scene = build_scene(all_tasks()[name])
        assert (scene.physics.opt.noslip_iterations, scene.untouched.opt.noslip_iterations) == (iterations, 0)
    task = all_tasks()["PressCube"]
    demonstration = demonstrations.load(None, task)
    sim = Simulation(task, num_worlds=2)
    sim.restore({name: np.repeat(values, 2, axis=0) for name, values in demonstration.start.items()})
    assert sim._touching(np.arange(2)).tolist() == [False, False]
    for action in demonstration.action.astype(np.float64):
        sim.step(np.stack([action, sim.command[1]]))  # one world presses on the cube, the other stands
    assert sim.contact_force("right", "cube")[0] > 1.0
    assert sim._touching(np.arange(2)).tolist() == [True, False]
    sim.close()


def test_a_stopwatch_counts_what_it_watches_and_passes_it_on() -> None:
    class Adder:
        def add(self, first: int, second: int) -> int:
            return sum(range(200_000)) * 0 + first + second

    adder, watch = Adder(), Stopwatch()
    watch.watch(adder, "add", "adding")
    assert adder.add(2, second=3) == 5
    once = watch.seconds["adding"]
    adder.add(1, 1)
    assert watch.seconds["adding"] > once > 0.0


def test_benchmark_of_the_simulation_compares_the_same_states(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", "simulation", "--task", "PressCube", "--num-worlds", "2"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["num_worlds"] == 2
    assert 0.0 < found["step_efficiency"] < 1.0
    assert found["steps_per_s"] < found["mj_steps_per_s"]


def test_benchmark_of_generation_accounts_for_all_time(capsys: pytest.CaptureFixture[str]) -> None:
    call = ["benchmark", "generation", "--task", "PressCube", "--region", "R1", "--num-attempts", "1"]
    assert cli.main(call) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["attempts"] == found["successes"] == 1
    shares = [value for name, value in found.items() if name.endswith("_share")]
    assert all(value > 0.0 for value in shares)
    assert sum(shares) == pytest.approx(1.0, abs=1e-3)
    assert found["episodes_per_hour_per_core"] == pytest.approx(3600.0 / found["cpu_s_per_attempt"], rel=0.01)
    assert cli.main([*call[:-1], "0"]) == 2


def test_benchmark_of_generation_compares_worlds_that_vary_with_plain_ones(capsys: pytest.CaptureFixture[str]) -> None:
    call = ["benchmark", "generation", "--task", "PressCube", "--region", "R1", "--num-attempts", "1"]
    assert cli.main([*call, "--variation", "real"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["variation"] == "real" and found["attempts"] == found["plain_successes"] == 1
    assert found["speed"] == pytest.approx(found["steps_per_s"] / found["plain_steps_per_s"], rel=1e-3)
    assert cli.main([*call, "--variation", "rael"]) == 2


def test_writing_is_five_times_as_fast_as_lerobots() -> None:
    found = dataset.measure_speed(rounds=1)  # raises where a column, statistic or entry differs
    assert found["write_speedup"] >= 5.0


def test_a_long_run_keeps_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "LENGTH", 1400)  # 0.6 MB an episode: 80 of them would be 48 MB
    found = dataset.measure_memory(96)
    assert found["rss_growth_mb"] < 24.0


@pytest.mark.slow
@pytest.mark.parametrize(("task", "region"), [("PressCube", "R1"), ("LiftBox", "R4")])  # R4 has a box of its own
def test_benchmark_of_pictures_splits_what_they_cost(
    task: str, region: str, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["benchmark", "pictures", "--task", task, "--region", region, "--cameras", "head:32x32:rgb,depth"]
    assert cli.main([*call, "--num-attempts", "1"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["successes"] == 1 and found["frames"] > 50
    assert found["ratio"] == pytest.approx(found["cpu_s_with_pictures"] / found["cpu_s_states"], abs=0.01)
    assert 0.0 < found["drawing_ms_per_frame"] < found["painting_ms_per_frame"]
    assert cli.main([*call, "--num-attempts", "0"]) == 2
