"""An episode's columns -> LeRobot's statistics of each, bit for bit, all dimensions at once.

LeRobot counts each dimension's frames in a histogram of 5000 bins and reads five quantiles off its cumulative sum, one
dimension after the other. The same numbers follow from the sorted frames: a quantile needs the two edges of its bin
alone, and these are found by bisection.
"""

from collections.abc import Mapping

import numpy as np
from lerobot.datasets.compute_stats import DEFAULT_QUANTILES, get_feature_stats

_BINS = 5000
_MARGIN = 1e-10  # by which the histogram is wider than the values, on each side
_HALVINGS = _BINS.bit_length()


def episode_stats(columns: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Return min, max, mean, std, count and quantiles by column, as LeRobot's ``compute_episode_stats``.

    Args:
        columns: By name, (T,) or (T, D) numbers or truth values, all finite.
    """
    return {name: _column_stats(values) for name, values in columns.items()}


def _column_stats(values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the statistics (D,) of one column."""
    count = len(values)
    if count < 2:
        return get_feature_stats(values, axis=0, keepdims=values.ndim == 1)
    frames = values.reshape(count, -1)
    frames = frames.astype(np.result_type(frames.dtype, np.float32), copy=False)
    mean, low, high = frames.mean(axis=0), frames.min(axis=0), frames.max(axis=0)
    stats = {
        "min": low,
        "max": high,
        "mean": mean,
        "std": np.sqrt(np.maximum(0, (frames**2).mean(axis=0) - mean**2)),
        "count": np.array([count]),
    }
    quantiles = _quantiles(frames, low - _MARGIN, high + _MARGIN)
    return stats | {f"q{int(share * 100):02d}": row for share, row in zip(DEFAULT_QUANTILES, quantiles, strict=True)}


def _quantiles(frames: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the quantiles (5, D) of frames (T, D) in a histogram from low to high (D,)."""
    step = (high - low) / _BINS

    def edge(index: np.ndarray) -> np.ndarray:
        """Return edges of bins in the precision of the frames, as ``np.linspace`` does, (5, D) -> (5, D)."""
        return np.where(index == _BINS, high, index.astype(frames.dtype) * step + low)

    wanted = np.array(DEFAULT_QUANTILES)[:, None] * len(frames)  # so many frames lie below a quantile
    ranked = np.sort(frames, axis=0)[np.ceil(wanted).astype(np.int64)[:, 0] - 1]  # the frame that makes it so many
    # The bin that this frame is in ends with the first edge above it; the last bin holds its own end too.
    below, above = np.zeros(ranked.shape, dtype=np.int64), np.full(ranked.shape, _BINS)
    for _ in range(_HALVINGS):
        middle = (below + above) // 2
        higher = edge(middle) > ranked
        below, above = np.where(higher, below, middle), np.where(higher, middle, above)
    start, end = edge(above - 1), edge(above)
    before = (frames < start[:, None]).sum(axis=1)
    inside = np.where(above == _BINS, len(frames), (frames < end[:, None]).sum(axis=1)) - before
    inner = start + (wanted - before) / inside * (end - start)
    return np.where(above == 1, start, inner)
