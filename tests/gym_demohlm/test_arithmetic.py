"""Arithmetic with the same bits on every processor: accurate, and the same for any batch, order and environment."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_demohlm import arithmetic
from gym_demohlm.arithmetic import ExactProduct


@pytest.mark.parametrize("name", ["arctan", "arcsin", "arccos"])
def test_inverse_functions_are_numpys(name: str) -> None:
    x = np.linspace(-1, 1, 1001).reshape(7, 143)
    np.testing.assert_allclose(getattr(arithmetic, name)(x), getattr(np, name)(x), rtol=1e-15, atol=1e-15)


def test_arctan2_knows_every_quadrant() -> None:
    angle = np.linspace(-np.pi, np.pi, 501)
    np.testing.assert_allclose(arithmetic.arctan2(3 * np.sin(angle), 3 * np.cos(angle)), angle, atol=1e-14)
    assert arithmetic.arctan2(0.0, 0.0) == 0.0
    assert arithmetic.arctan2(np.float64(1.0), 1.0).shape == ()


def test_elu_is_within_its_bound() -> None:
    x = np.concatenate([np.linspace(-60, 0, 40001), np.linspace(0, 9, 100)])
    expected = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    np.testing.assert_allclose(arithmetic.elu(x), expected, rtol=0, atol=1e-9)


def test_norm_and_dot_are_numpys() -> None:
    vectors = np.random.default_rng(0).normal(size=(5, 7, 3))
    np.testing.assert_allclose(arithmetic.norm(vectors), np.linalg.norm(vectors, axis=-1), rtol=1e-15)
    np.testing.assert_allclose(arithmetic.dot(vectors, vectors[0]), np.einsum("abi,bi->ab", vectors, vectors[0]))
    np.testing.assert_allclose(arithmetic.hypot(vectors[..., 0], vectors[..., 1]), np.hypot(*vectors.T[:2]).T)


def test_a_transposed_product_is_numpys() -> None:
    rng = np.random.default_rng(3)
    A, b = rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 4))
    expected = [matrix.T @ vector for matrix, vector in zip(A, b, strict=True)]
    np.testing.assert_allclose(arithmetic.transposed_product(A, b), expected, rtol=1e-13, atol=1e-15)


def test_least_squares_and_eigh_are_numpys() -> None:
    rng = np.random.default_rng(1)
    A, b = rng.normal(size=(30, 9)), rng.normal(size=30)
    np.testing.assert_allclose(arithmetic.least_squares(A, b), np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-13)
    symmetric = A.T @ A
    values, vectors = arithmetic.eigh(symmetric)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(symmetric), rtol=1e-12)
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, symmetric, atol=1e-12)


@given(st.integers(1, 90), st.integers(1, 40), st.integers(1, 150), st.floats(0.01, 100.0), st.integers(0, 2**32 - 1))
def test_products_are_exact(rows: int, inner: int, columns: int, bound: float, seed: int) -> None:
    """Whole numbers of Python have no rounding: the product of what was rounded to the grids is exactly theirs."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(inner, columns))
    product = ExactProduct(matrix, bound)
    x = rng.uniform(-bound, bound, (rows, inner))
    result = product(x)
    worst = bound * product.matrix_step + np.abs(matrix).max() * product.row_step
    np.testing.assert_allclose(result, x @ matrix, atol=inner * worst)
    row, column = rng.integers(rows), rng.integers(columns)
    steps = [round(value) for value in x[row] / product.row_step]
    weights = [round(value) for value in product.matrix[:, column] / product.matrix_step]
    exact = sum(a * b for a, b in zip(steps, weights, strict=True))
    assert result[row, column] == exact * (product.row_step * product.matrix_step)


def test_a_product_is_the_same_for_any_batch_order_and_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    matrix, x = rng.normal(size=(191, 256)), rng.normal(scale=3, size=(70, 191))
    together = ExactProduct(matrix, 6.0)(x)
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    in_pieces = ExactProduct(matrix, 6.0)
    order = rng.permutation(191)
    shuffled = ExactProduct(matrix[order], 6.0)
    assert np.array_equal(in_pieces(x), together)
    assert np.array_equal(shuffled(x[:, order]), together)
    assert all(np.array_equal(in_pieces(x[i]), together[i]) for i in range(70))


def test_a_product_clips_to_its_bound() -> None:
    product = ExactProduct(np.eye(2), 4.0)
    assert product(np.array([9.0, -1e300])).tolist() == [4.0, -4.0]
