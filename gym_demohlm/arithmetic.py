"""Sums, products and elementary functions that have the same bits on every x86-64 processor.

NumPy and OpenBLAS choose their code by the processor. What they choose rounds the same way almost everywhere: sums,
element by element arithmetic, square roots, sines and cosines, products of 3x3 and 4x4 matrices. The exceptions are

- products that OpenBLAS adds up in an order of its own: larger matrices, and the dot product even of two 3-vectors;
- factorisations built on them (``np.linalg.solve``, ``eigh``);
- ``exp``, ``arctan``, ``arctan2``, ``arcsin``, ``arccos``, ``power``, which NumPy takes from another library where the
  processor has AVX-512.

Whatever decides a bit of the simulation, the controller, inverse kinematics or generation uses this module for these.
``demohlm doctor`` checks the outcome.
"""

import math
import os
import sys

import eigenpy
import numpy as np

_EXACT_BITS = 52  # float64 holds every integer up to 2**53: one bit to spare
_ONE_THREAD = 262144  # multiplications: OpenBLAS hands larger products to threads, which wait long for one another
_COLUMNS = 64
_ELU_FLOOR = -24.0  # below it, exp(x) - 1 is -1 within 1e-10
_HALVINGS = 6

# frompyfunc calls the C library for each element, whatever the processor: quick enough for the few numbers of a tick.
_arctan2 = np.frompyfunc(math.atan2, 2, 1)
_arctan = np.frompyfunc(math.atan, 1, 1)
_arcsin = np.frompyfunc(math.asin, 1, 1)
_arccos = np.frompyfunc(math.acos, 1, 1)


def arctan2(y: np.ndarray | float, x: np.ndarray | float) -> np.ndarray:
    """Return the angle of (x, y) [rad], element by element."""
    return np.asarray(_arctan2(y, x), dtype=np.float64)


def arctan(x: np.ndarray | float) -> np.ndarray:
    """Return the angle in (-pi/2, pi/2) whose tangent is x [rad], element by element."""
    return np.asarray(_arctan(x), dtype=np.float64)


def arcsin(x: np.ndarray | float) -> np.ndarray:
    """Return the angle in [-pi/2, pi/2] whose sine is x [rad], element by element; x in [-1, 1]."""
    return np.asarray(_arcsin(x), dtype=np.float64)


def arccos(x: np.ndarray | float) -> np.ndarray:
    """Return the angle in [0, pi] whose cosine is x [rad], element by element; x in [-1, 1]."""
    return np.asarray(_arccos(x), dtype=np.float64)


def hypot(x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
    """Return the length of (x, y), element by element; for lengths whose squares float64 can hold."""
    return np.sqrt(np.multiply(x, x) + np.multiply(y, y))


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of vectors, (..., n) and (..., n) -> (...)."""
    return (a * b).sum(axis=-1)


def norm(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors, (..., n) -> (...)."""
    return np.sqrt(dot(vectors, vectors))


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


def elu(x: np.ndarray) -> np.ndarray:
    """Return the exponential linear unit, x where positive and exp(x) - 1 elsewhere, within 1e-9; of any shape.

    exp(x) is a Taylor polynomial at x / 64, squared six times: only additions and multiplications.
    """
    y = np.clip(x, _ELU_FLOOR, 0.0)
    y *= 0.5**_HALVINGS
    power = y * (1.0 / 120.0)
    for coefficient in (1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0):
        power += coefficient
        power *= y
    power += 1.0
    for _ in range(_HALVINGS):
        power *= power
    power -= 1.0
    power += np.maximum(x, 0.0)
    return power


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
        flat = np.clip(rows.reshape(-1, width), -self.bound, self.bound)
        flat *= 1.0 / self.row_step
        np.rint(flat, out=flat)
        product = np.empty((len(flat), self.matrix.shape[1]))
        for first in range(0, len(flat), self._block):
            block, into = flat[first : first + self._block], product[first : first + self._block]
            column = 0
            for piece in self._pieces:
                np.matmul(block, piece, out=into[:, column : column + piece.shape[1]])
                column += piece.shape[1]
        return product.reshape(*lead, -1)
