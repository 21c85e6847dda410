"""A picture -> which pixels belong to an object: from the renderer's ids, or from colours alone.

``oracle`` takes the renderer's ids and makes their edges rough, as those of a good segmentation network are. It is no
perception: a network would err in its own ways, too. ``color`` uses the picture and the object's known colours; what is
grey has none.
"""

import math
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.perception import smooth_noise
from gym_demohlm.perception.meshes import ObjectMesh

_EDGE_BLUR = 1.0  # px
_EDGE_CORRELATION = 4.0  # px, along which an edge errs one way
_MARGIN = 4  # px
_DARK = 24.0  # of 255: a darker pixel has no colour to speak of
_TOLERANCE = 0.05  # distance of the shares of red and green, below which two colours are one


def oracle(ids: np.ndarray, geoms: Sequence[int] | np.ndarray, rng: np.random.Generator, jitter: float) -> np.ndarray:
    """Return the pixels (height, width) bool of some geoms, with edges that are off by some pixels.

    Args:
        ids: (height, width) geom seen in each pixel.
        geoms: Which.
        rng: Source of the randomness; what is drawn depends on the mask's size.
        jitter: Standard deviation of an edge's place [px], at most 1; 0 gives the exact mask.
    """
    table = np.zeros(max(int(ids.max(initial=-1)), int(np.max(geoms, initial=-1))) + 2, np.uint8)
    table[np.asarray(geoms, dtype=np.int64)] = 1
    exact = table[ids]  # id -1 is the table's last entry, which is 0
    if jitter <= 0:
        return exact.astype(bool)
    left, top, columns, rows = cv2.boundingRect(exact)
    rough = np.zeros(ids.shape, bool)
    if rows == 0:
        return rough
    near = slice(max(0, top - _MARGIN), top + rows + _MARGIN), slice(max(0, left - _MARGIN), left + columns + _MARGIN)
    part = exact[near]
    blurred = cv2.GaussianBlur(part.astype(np.float32), (0, 0), _EDGE_BLUR)
    slope = 1.0 / (_EDGE_BLUR * math.sqrt(2.0 * math.pi))  # of a blurred edge [1/px]
    error = smooth_noise.piece((part.shape[0], part.shape[1]), _EDGE_CORRELATION, rng)
    rough[near] = blurred + np.clip(jitter * slope * error, -0.49, 0.49) > 0.5
    return rough


def grey(meshes: Iterable[ObjectMesh]) -> list[str]:
    """Return the names of objects with white, grey or black parts, which ``color`` cannot tell from walls."""

    def has_grey(colors: np.ndarray) -> bool:
        black = np.asarray(colors).sum(axis=1) < 3 * _DARK / 255
        return bool((black | (np.linalg.norm(_shares(colors) - 1 / 3, axis=1) < _TOLERANCE)).any())

    return [mesh.name for mesh in meshes if has_grey(mesh.colors)]


def refuse_grey(meshes: Iterable[ObjectMesh]) -> None:
    """Check that ``color`` can find each object.

    Raises:
        SceneError: A part of one is white, grey or black.
    """
    names = grey(meshes)
    if names:
        raise SceneError(
            f"masks=color, and parts of {', '.join(names)} that are white, grey or black",
            "objects in colour, as a grey one cannot be told from walls and floor by its colour",
            "use masks=oracle, or tags: perception=apriltag",
        )


def color(image: np.ndarray, colors: np.ndarray, tolerance: float = _TOLERANCE) -> np.ndarray:
    """Return the pixels (height, width) bool whose chromaticity is near one of an object's colours.

    Args:
        image: (height, width, 3) uint8.
        colors: (n, 3) the object's colours, of any brightness.
        tolerance: Largest distance of red and green shares.
    """
    pixels = image.astype(np.float32)
    total = pixels.sum(axis=-1)
    shares = pixels[..., :2] / np.maximum(total, 1.0)[..., None]
    apart = np.min([((shares - one) ** 2).sum(axis=-1) for one in _shares(colors)], axis=0)
    found = (apart < tolerance**2) & (total > 3 * _DARK)
    cleaned = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.morphologyEx(cleaned, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(bool)


def _shares(colors: np.ndarray) -> np.ndarray:
    """Return the shares (n, 2) float32 of red and green in colours (n, 3)."""
    wanted = np.asarray(colors, dtype=np.float32)
    return wanted[:, :2] / np.maximum(wanted.sum(axis=1, keepdims=True), 1e-6)


def component_near(mask: np.ndarray, expected: tuple[float, float] | None, least: int) -> np.ndarray:
    """Return the connected part of a mask that is nearest to where it is expected, or the largest one.

    Args:
        mask: (height, width) bool.
        expected: Column and row in the mask [px]; None where nothing is known.
        least: Fewest pixels of a part that counts.
    """
    count, labels, facts, middles = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = [part for part in range(1, count) if facts[part, cv2.CC_STAT_AREA] >= least]
    if not large:
        return np.zeros_like(mask)
    if expected is None:
        best = max(large, key=lambda part: facts[part, cv2.CC_STAT_AREA])
    else:
        best = min(large, key=lambda part: float(np.hypot(*(middles[part] - np.array(expected)))))
    return labels == best
