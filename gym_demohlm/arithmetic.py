"""Sums, products and elementary functions that have the same bits on every x86-64 processor.

NumPy and OpenBLAS choose their code by the processor. What they choose rounds the same way almost everywhere: sums,
element by element arithmetic, square roots, sines and cosines, products of 3x3 and 4x4 matrices. The exceptions are

- products that OpenBLAS adds up in an order of its own: larger matrices, the dot product even of two 3-vectors, and a
  transposed matrix times a vector;
- factorisations built on them (``np.linalg.solve``, ``eigh``);
- ``exp``, ``arctan``, ``arctan2``, ``arcsin``, ``arccos``, ``power``, which NumPy takes from another library where the
  processor has AVX-512.

Whatever decides a bit of the simulation, the controller, inverse kinematics or generation uses this module for these.
Numba compiles its functions: it neither reorders nor fuses additions and multiplications, and it takes ``atan2`` and
its like from the C library.
``demohlm doctor`` checks the outcome.
"""

import inspect
import math
import os
import sys
from collections.abc import Callable

import eigenpy
import numba
import numpy as np

_EXACT_BITS = 52  # float64 holds every integer up to 2**53: one bit to spare
_ONE_THREAD = 262144  # multiplications: OpenBLAS hands larger products to threads, which wait long for one another
_COLUMNS = 64


def _element_by_element(function: Callable[..., float]) -> np.ufunc:
    """Compile a function of numbers into one of arrays; its arithmetic is carried out as it is written."""
    arguments = ", ".join(["float64"] * len(inspect.signature(function).parameters))
    compiled = numba.vectorize([f"float64({arguments})"], cache=True)(function)
    return compiled.ufunc  # pyright: ignore[reportAttributeAccessIssue]  calls of it skip numba's own checks


@_element_by_element
def arctan2(y: float, x: float) -> float:
    """Return the angle of (x, y) [rad], element by element."""
    return math.atan2(y, x)


@_element_by_element
def arctan(x: float) -> float:
    """Return the angle in (-pi/2, pi/2) whose tangent is x [rad], element by element."""
    return math.atan(x)


@_element_by_element
def arcsin(x: float) -> float:
    """Return the angle in [-pi/2, pi/2] whose sine is x [rad], element by element; x in [-1, 1]."""
    return math.asin(x)


@_element_by_element
def arccos(x: float) -> float:
    """Return the angle in [0, pi] whose cosine is x [rad], element by element; x in [-1, 1]."""
    return math.acos(x)


def elu_of_number(x: float) -> float:
    """Return the exponential linear unit, x where positive and exp(x) - 1 elsewhere, within 1e-9.

    exp(x) is a Taylor polynomial at x / 64, squared six times: only additions and multiplications.
    """
    y = min(max(x, -24.0), 0.0) * (1.0 / 64.0)  # below -24, exp(x) - 1 is -1 within 1e-10
    power = 1.0 + y * (1.0 + y * (1.0 / 2.0 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0)))))
    power *= power
    power *= power
    power *= power
    power *= power
    power *= power
    power *= power
    return max(x, 0.0) + (power - 1.0)


elu = _element_by_element(elu_of_number)
"""The same of arrays, element by element."""


@_element_by_element
def hypot(x: float, y: float) -> float:
    """Return the length of (x, y), element by element; for lengths whose squares float64 can hold."""
    return math.sqrt(x * x + y * y)


@_element_by_element
def _whole_steps(x: float, per_unit: float, most: float) -> float:
    """Return x in whole steps of a grid of ``per_unit`` steps a unit, ``most`` at most, element by element."""
    return np.rint(min(max(x * per_unit, -most), most))


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of vectors, (..., n) and (..., n) -> (...)."""
    return (a * b).sum(axis=-1)


def norm(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors, (..., n) -> (...)."""
    return np.sqrt(dot(vectors, vectors))


def transposed_product(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ``A.T @ b``, (..., n, m) and (..., n) -> (..., m)."""
    return (A * b[..., None]).sum(axis=-2)


def least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the x that minimises ``|A x - b|``, by Householder's QR factorisation.

    Args:
        A: (m, n) of full column rank, m >= n.
        b: (m,) or (m, k).

    Returns:
        (n,) or (n, k).
    """
    return eigenpy.HouseholderQR(A).solve(b)


def eigh(symmetric: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvalues, ascending (n,), and the eigenvectors as columns (n, n) of a symmetric matrix (n, n)."""
    found = eigenpy.SelfAdjointEigenSolver(symmetric)
    return found.eigenvalues().copy(), found.eigenvectors().copy()


def _one_thread() -> bool:
    """Return whether the environment keeps OpenBLAS to one thread."""
    return "1" in (os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS"))


class ExactProduct:
    """A fixed matrix by which rows are multiplied without any rounding, so in any order, batch and number of threads.

    Both factors are rounded to grids so coarse that float64 holds every partial sum exactly. Rows beyond the bound are
    clipped to it.

    Args:
        matrix: (n, m).
        bound: The largest magnitude that an element of a row may have.

    Attributes:
        matrix_step: Spacing of the grid of the matrix.
        row_step: Spacing of the grid of the rows.
    """

    def __init__(self, matrix: np.ndarray, bound: float) -> None:
        matrix = np.asarray(matrix, dtype=np.float64)
        largest = float(np.abs(matrix).max()) or 1.0  # any grid does for zeros
        # |sum| <= bound * (largest column sum); the matrix gets the finer grid, its errors do not average out.
        largest_sum = bound * max(float(np.abs(matrix).sum(axis=0).max()), largest)
        sum_bits = math.ceil(math.log2(1.01 * largest_sum))
        bits = _EXACT_BITS - sum_bits
        matrix_bits = (bits + math.ceil(math.log2(bound / largest)) + 1) // 2
        self.bound, self.matrix_step, self.row_step = bound, 2.0**-matrix_bits, 2.0 ** (matrix_bits - bits)
        grid = np.rint(matrix / self.matrix_step)
        self.matrix = grid * self.matrix_step
        scaled = self.matrix * self.row_step  # rows are multiplied as whole numbers of steps
        starts = range(0, scaled.shape[1], _COLUMNS)
        self._pieces = [np.ascontiguousarray(scaled[:, first : first + _COLUMNS]) for first in starts]
        self._block = max(1, _ONE_THREAD // self._pieces[0].size)
        if _one_thread():
            self._pieces, self._block = [scaled], sys.maxsize

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return ``rows @ matrix``, (..., n) -> (..., m); the same bits for a row alone and among others."""
        lead, width = rows.shape[:-1], rows.shape[-1]
        flat = _whole_steps(rows.reshape(-1, width), 1.0 / self.row_step, self.bound / self.row_step)
        return self.of_steps(flat).reshape(*lead, -1)

    def of_steps(self, flat: np.ndarray) -> np.ndarray:
        """Return the same for rows (N, n) that are whole numbers of ``row_step`` within the bound, (N, m)."""
        product = np.empty((len(flat), self.matrix.shape[1]))
        for first in range(0, len(flat), self._block):
            block, into = flat[first : first + self._block], product[first : first + self._block]
            column = 0
            for piece in self._pieces:
                np.matmul(block, piece, out=into[:, column : column + piece.shape[1]])
                column += piece.shape[1]
        return product
