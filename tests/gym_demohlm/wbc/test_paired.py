"""Two controllers on the same commands: equal ones do not differ, a worse one is told, and intervals hold the truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_demohlm.wbc.evaluation import paired
from gym_demohlm.wbc.evaluation.episodes import LIGHT_ROWS, PLAIN_ROWS, Samples, Trials

_ROBOTS, _TICKS = 40, 30


def _trials(rng: np.random.Generator, scale: float = 1.0, falls: int = 0) -> Trials:
    """Return what robots would show whose errors are those of a generator times a scale."""
    found = Trials()
    for groups, names in (
        (found.plain, set(PLAIN_ROWS.values())),
        (found.pushed, set()),
        (found.light, set(LIGHT_ROWS.values())),
    ):
        samples = Samples({}, np.arange(_ROBOTS) >= falls)
        for name in sorted(names):
            for _ in range(_TICKS):
                samples.add(name, scale * rng.uniform(0.5, 1.5, _ROBOTS), np.arange(_ROBOTS))
        groups.append(samples)
    return found


def test_a_controller_does_not_differ_from_itself() -> None:
    same = _trials(np.random.default_rng(0))
    for row in paired.compare(same, same):
        assert row.new == row.old
        assert row.low == row.high == 0.0
        assert not row.worse


@pytest.mark.parametrize(("scale", "falls", "worse"), [(1.1, 20, True), (0.9, 0, False)])
def test_a_worse_controller_is_told_in_every_number(scale: float, falls: int, worse: bool) -> None:
    old = _trials(np.random.default_rng(0))
    rows = paired.compare(_trials(np.random.default_rng(0), scale, falls), old)
    assert [row.name for row in rows] == list(paired.ACCEPTED)
    assert all(row.worse == worse for row in rows)
    for row in rows:
        if row.name not in paired.HIGHER_IS_BETTER:
            assert row.new == pytest.approx(scale * row.old)
            assert row.low <= row.new - row.old <= row.high


def test_a_robot_weighs_as_much_as_it_was_up() -> None:
    """Two samples of 1 and one of 4 have the mean 2, whichever robots they are of."""
    found = _trials(np.random.default_rng(0))
    samples = Samples({}, np.ones(2, dtype=bool))
    samples.add("walking/linear_velocity", np.array([1.0, 4.0]), np.arange(2))
    samples.add("walking/linear_velocity", np.array([1.0]), np.array([0]))
    trials = Trials(plain=[samples], pushed=found.pushed, light=found.light)
    assert trials.rows()["linear_velocity_error"] == pytest.approx(2.0)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000))
def test_chance_alone_is_seldom_taken_for_worse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = paired.compare(_trials(rng), _trials(rng))
    assert sum(row.worse for row in rows) <= 4  # of twelve, each of which errs in one of forty
