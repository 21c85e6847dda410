"""Random images whose neighbouring pixels err alike: pieces of a sheet that is drawn once.

Fresh noise for each frame takes longer. So each process draws one sheet for each blur, always the same one. A frame
gets a piece of it: where it is cut, which way it is mirrored, and its sign are random. Pieces often overlap on the
sheet, but then they are shifted or mirrored against one another: hardly ever does a pixel err twice in the same way.
"""

import functools
import math

import cv2
import numpy as np

_SHEET = (1536, 1920)  # rows and columns [px]: nine cuts of a picture of 640 x 480 would not overlap
_SHEET_SEED = 435
_SMOOTH = 2.0  # px of blur, from which on noise is drawn at half the resolution
_KERNEL_REACH = 4  # a Gaussian kernel's half length in standard deviations


def piece(shape: tuple[int, int], blur: float, rng: np.random.Generator, deviation: float = 1.0) -> np.ndarray:
    """Return normal noise (height, width) float32, correlated as a Gaussian blur leaves it; a new array.

    Args:
        shape: Height and width. What is larger than the sheet is drawn afresh.
        blur: Standard deviation of the Gaussian [px]; 0 for white noise.
        rng: Source of the randomness; how much is drawn depends on the shape alone.
        deviation: Standard deviation of a pixel.
    """
    sheet = _sheet(blur)
    spare = np.subtract(sheet.shape, shape)
    if (spare < 0).any():
        return np.float32(deviation) * _fresh(shape, blur, rng)
    row, column, turns = rng.integers(0, [spare[0] + 1, spare[1] + 1, 8]).tolist()
    cut = sheet[row : row + shape[0], column : column + shape[1]]
    cut = cut[:: -1 if turns & 1 else 1, :: -1 if turns & 2 else 1]
    return cut * np.float32(-deviation if turns & 4 else deviation)


def _fresh(shape: tuple[int, int], blur: float, rng: np.random.Generator) -> np.ndarray:
    """Return fresh noise of standard deviation 1, see ``piece``.

    Smooth noise is drawn at half the resolution or less, and interpolated.
    """
    if blur >= _SMOOTH:
        rows, columns = shape
        coarse = _fresh(((rows + 1) // 2, (columns + 1) // 2), blur / 2.0, rng)
        fine = cv2.resize(coarse, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
        # Each pixel is 3/4 of a neighbour and 1/4 of the next, both ways; neighbours are alike by exp(-1 / (2 b)^2).
        return fine * np.float32(1.0 / (0.625 + 0.375 * math.exp(-1.0 / blur**2)))
    white = rng.standard_normal(shape, np.float32)
    if blur <= 0:
        return white
    length = 2 * max(1, round(_KERNEL_REACH * blur)) + 1
    kernel = cv2.getGaussianKernel(length, blur)
    deviation = float((kernel**2).sum())  # of white noise after the kernel both ways
    return cv2.sepFilter2D(white, -1, kernel, kernel) / np.float32(deviation)


@functools.cache
def _sheet(blur: float) -> np.ndarray:
    return _fresh(_SHEET, blur, np.random.default_rng(_SHEET_SEED))
