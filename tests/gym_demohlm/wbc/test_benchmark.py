"""What the benchmark counts: averages over a gait cycle, falls by load and posture, intervals of survival."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_demohlm.control import command
from gym_demohlm.wbc.evaluation import benchmark, episodes
from gym_demohlm.wbc.evaluation.cycle import CycleMean
from gym_demohlm.wbc.evaluation.episodes import posture
from gym_demohlm.wbc.evaluation.intervals import wilson
from gym_demohlm.wbc.evaluation.trial import Disturbance, trial_simulation


def test_a_cycle_of_a_walk_averages_to_the_way_it_went() -> None:
    simulation = trial_simulation(2)
    told = np.tile(command.rest(), (2, 1))
    told[:, 0], told[1, 2] = 0.4, 0.5
    cycle = CycleMean(simulation, 0.6)  # whole steps, so that poses tell the same
    assert cycle.steps == 6
    places = []
    for _ in range(40):
        simulation.step(told)
        cycle.add()
        places.append(simulation.pose("pelvis"))
    before, now = places[-7], places[-1]
    went = np.linalg.norm((now - before)[:, :2, 3], axis=1) / 0.6
    yaw = [np.arctan2(T[:, 1, 0], T[:, 0, 0]) for T in (before, now)]
    found = cycle.mean()
    np.testing.assert_allclose(np.hypot(found[0, 0], found[0, 1]), went[0], atol=0.01)  # m/s, walking straight on
    np.testing.assert_allclose(found[:, 2], (yaw[1] - yaw[0]) / 0.6, atol=0.03)  # rad/s


def test_a_robot_that_is_left_out_keeps_its_cycle() -> None:
    simulation = trial_simulation(2)
    cycle = CycleMean(simulation, 0.2)
    for _ in range(3):
        simulation.step(np.tile(command.rest(), (2, 1)))
        cycle.add()
    before = cycle.mean()
    simulation.step(np.tile(command.rest(), (2, 1)), active=np.array([True, False]))
    cycle.add()
    assert np.array_equal(cycle.mean()[1], before[1])
    assert not np.array_equal(cycle.mean()[0], before[0])


@given(st.integers(1, 2000), st.floats(0, 1))
def test_an_interval_holds_its_share_and_narrows_with_trials(count: int, share: float) -> None:
    low, high = wilson(share, count)
    assert -1e-9 <= low <= share + 1e-9
    assert share - 1e-9 <= high <= 1 + 1e-9
    wider = wilson(share, max(1, count // 2))
    assert high - low <= wider[1] - wider[0] + 1e-9


def test_six_hundred_episodes_without_a_fall_show_99_4_percent() -> None:
    assert wilson(1.0, 600)[0] == pytest.approx(0.9936, abs=1e-4)


@pytest.mark.parametrize(
    ("told", "name"),
    [
        ({}, "upright"),
        ({command.HEIGHT: 0.5}, "low"),
        ({command.PITCH: 0.8}, "bent"),
        ({command.PITCH: 0.8, command.HEIGHT: 0.5}, "low and bent"),
        ({command.YAW: -0.8}, "turned"),
    ],
)
def test_postures_are_told_apart(told: dict[int, float], name: str) -> None:
    commands = command.rest()
    commands[list(told)] = list(told.values())
    assert posture(commands, walks=False) == name
    assert posture(commands, walks=True) == "walking"


def test_falls_are_counted_by_load_and_posture(monkeypatch: pytest.MonkeyPatch) -> None:
    """A push of 3 m/s fells everyone; each fall is counted once, where it was."""
    monkeypatch.setattr(episodes, "PUSH_SPEED", 3.0)
    monkeypatch.setattr(episodes, "NUM_LOADS", 2)
    found = benchmark.benchmark(num_worlds=4, seconds=7.0, seed=3, num_threads=1, num_seeds=2)
    assert found["survival_pushed"] == 0.0
    assert [group["robots"] for group in found["falls_by_load"]] == [1, 1, 1, 1]
    assert sum(group["falls_pushed"] for group in found["falls_by_load"]) == 4
    by_posture = found["falls_by_posture_pushed"]
    assert sum(entry["falls"] for entry in by_posture.values()) == 4
    assert sum(entry["told"] for entry in found["falls_by_posture"].values()) == 8  # 4 robots, two commands each
    for name in ("linear_velocity_error_cycle", "yaw_rate_error_cycle", "walking_power_velocity_only"):
        assert 0.0 < found[name] < 200.0
    assert 0.0 <= found["reflex_share"] <= 1.0
    assert found["linear_velocity_error_cycle"] < found["linear_velocity_error"]
    assert found["survival_low"] < found["survival"]


def test_loads_of_a_robot_are_those_it_is_counted_under() -> None:
    heavy = trial_simulation(1, Disturbance(hand_loads=(2.0, 1.0)))
    assert heavy.model.body_subtreemass[1] == pytest.approx(trial_simulation(1).model.body_subtreemass[1] + 3.0)
