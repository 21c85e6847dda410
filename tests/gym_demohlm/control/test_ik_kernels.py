"""Compiled kernels of inverse kinematics against NumPy: equal bit for bit."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_demohlm.control.kernels import ik as kernels
from gym_demohlm.control.whole_body import Weights

_REFERENCE = Weights().make_reference()
_SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=50, deadline=None)
@given(
    seed=_SEEDS,
    n=st.sampled_from([14, 18]),
    hands=st.tuples(st.booleans(), st.booleans()),
    head=st.booleans(),
    size=st.sampled_from([0.0, 1e-3, 1.0]),
)
def test_a_problem_has_the_bits_of_numpy(seed: int, n: int, hands: tuple[bool, bool], head: bool, size: float) -> None:
    rng = np.random.default_rng(seed)
    q, posture, pull = rng.normal(size=(3, n))
    columns, scale = 6 + np.arange(n), np.abs(rng.normal(size=6))
    jacobians, base = rng.normal(size=(3, 6, 6 + n)), size * rng.normal(size=(3, n))
    errors = size * rng.normal(size=(2, 6)) * np.array(hands)[:, None]
    p_head, T_head = rng.normal(size=3), np.eye(4) + rng.normal(size=(4, 4))
    A, b = np.full((2 * n + 15, n), np.nan), np.full(2 * n + 15, np.nan)
    rows = kernels.problem(
        q, posture, pull, columns, scale, 2e-3, 1.5, np.array(hands), errors, jacobians[:2], base, A, b
    )
    if head:
        kernels.head_rows(0.7, columns, jacobians[2], base, p_head, T_head, rows, A, b)
        rows += 3

    scaled = errors * scale
    damping = 2e-3 + 1.5 * (scaled**2).sum()
    expected, values = [np.diag(pull), np.sqrt(damping) * np.eye(n)], [pull * (posture - q), np.zeros(n)]
    for hand in range(2):
        if hands[hand]:
            jacobian = jacobians[hand][:, columns]
            jacobian[:3] += base
            expected.append(scale[:, None] * jacobian)
            values.append(scaled[hand])
    if head:
        expected.append(0.7 * (jacobians[2][:3, columns] + base))
        values.append(0.7 * (p_head - T_head[:3, 3]))
    assert A[:rows].tobytes() == np.concatenate(expected).tobytes()
    assert b[:rows].tobytes() == np.concatenate(values).tobytes()


@settings(max_examples=50, deadline=None)
@given(seed=_SEEDS, small=st.booleans())
def test_steps_and_their_bounds_have_the_bits_of_numpy(seed: int, small: bool) -> None:
    rng = np.random.default_rng(seed)
    q, change, straightest, lowest = rng.normal(size=(4, 23))
    step, highest = np.abs(rng.normal(size=23)), lowest + np.abs(rng.normal(size=23))
    straightest[rng.random(23) < 0.5] = np.inf
    lower, upper, bent = np.empty((3, 23))
    kernels.window(q, step, lowest, highest, straightest, lower, upper, bent)
    assert np.array_equal(lower, np.clip(lowest, q - step, q + step))
    assert np.array_equal(upper, np.clip(highest, q - step, q + step))
    assert np.array_equal(bent, np.minimum(upper, np.maximum(straightest, lower)))
    low, high = q - 1.0, q + 1.0
    change = 0.5 * np.tanh(change) if small else change
    inside = bool((change <= high - q).all() and (change >= low - q).all())
    assert kernels.within(change, q, low, high) == inside
    expected, largest = np.clip(q + change, low, high), np.abs(change).max()
    assert kernels.move(change, q, low, high) == largest
    assert q.tobytes() == expected.tobytes()


@settings(max_examples=100, deadline=None)
@given(
    height=st.floats(0.2, 1.0),
    pitch=st.floats(-0.6, 1.6),
    here=st.floats(-0.2, 0.2),
    seed=_SEEDS,
)
def test_the_pelvis_backs_off_by_the_bits_of_the_reference(height: float, pitch: float, here: float, seed: int) -> None:
    expected = _REFERENCE.pelvis_ahead(height, pitch)
    assert kernels.pelvis_ahead(_REFERENCE.ahead, height, pitch) == expected
    T = np.random.default_rng(seed).normal(size=(4, 4))
    state, base, slope = np.zeros(7), np.zeros((3, 18)), np.zeros(18)
    kernels.advanced(_REFERENCE.ahead, here, T, height, pitch, 2, state, base)
    slope[0], slope[2] = expected[1:]
    assert state[:3].tobytes() == (T[:3, 3] + (expected[0] - here) * T[:3, 0]).tobytes()
    assert np.array_equal(base, np.outer(T[:3, 0], slope))


@given(seed=_SEEDS)
@settings(max_examples=30, deadline=None)
def test_lengths_have_the_bits_of_numpy(seed: int) -> None:
    errors = np.random.default_rng(seed).normal(size=(2, 6))
    translations, rotations = kernels.lengths(errors)
    assert np.array_equal(translations, np.linalg.norm(errors[:, :3], axis=1))
    assert np.array_equal(rotations, np.linalg.norm(errors[:, 3:], axis=1))
