"""A drawn picture -> what a colour camera would give of it: blur of the lens, noise of the sensor."""

import cv2
import numpy as np

BLUR = 0.8  # px
NOISE = 4.0  # of 255, standard deviation of a pixel


def photographed(picture: np.ndarray, rng: np.random.Generator, blur: float = BLUR, noise: float = NOISE) -> np.ndarray:
    """Return a picture (height, width[, 3]) uint8 with blur and noise.

    Args:
        picture: (height, width) or (height, width, 3) uint8.
        rng: Source of the noise.
        blur: Standard deviation of the Gaussian [px]; 0 for none.
        noise: Standard deviation of each pixel, of 255.
    """
    soft = cv2.GaussianBlur(picture, (0, 0), blur) if blur > 0 else picture
    noisy = soft + np.float32(noise) * rng.standard_normal(picture.shape, np.float32)
    return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)
