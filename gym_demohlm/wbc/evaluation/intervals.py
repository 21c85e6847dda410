"""Shares of trials that went well -> their intervals."""

from typing import overload

import numpy as np

_Z = 1.959964  # 95 %


@overload
def wilson(share: float, count: int) -> tuple[float, float]: ...


@overload
def wilson(share: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]: ...


def wilson(share: float | np.ndarray, count: int) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Return the 95 % Wilson interval of shares out of ``count`` trials each."""
    middle = (share + _Z * _Z / (2 * count)) / (1 + _Z * _Z / count)
    half = _Z / (1 + _Z * _Z / count) * np.sqrt(share * (1 - share) / count + _Z * _Z / (4 * count * count))
    return np.minimum(middle - half, share), np.maximum(middle + half, share)  # they may differ by rounding alone
