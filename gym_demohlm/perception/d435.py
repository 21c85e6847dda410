"""True depth -> what a RealSense D435 would measure: noise, steps of disparity, blurred edges, shadows, holes.

A stereo camera measures disparity ``d = f B / z``. An error of s pixels in it is an error of ``z**2 s / (f B)`` in
depth, and disparity comes in steps of 1/32 pixel (Intel, "Tuning depth cameras for best performance"; s is 0.032 at
best and about 0.08 in use). Left of a near thing's edge only one of the two imagers sees the background: a shadow
without depth. Matching windows blur the edges, which tremble and grow by about a pixel. How wide they grow and how
many of their pixels have no depth are guesses. Each episode has one error of scale, as cameras have after a knock.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np

from gym_demohlm.errors import SceneError
from gym_demohlm.perception import smooth_noise

HOLE = 0.0
"""Depth of a pixel that was not measured, as in the camera's own stream."""

_EDGE = 0.5  # px of disparity between neighbours at an edge
_SHADOW_STEPS = (4, 8, 12, 16, 24)  # px, where a nearer thing is looked for
_JITTER_BLUR = 2.0  # px, over which an edge's place errs one way
_GLASS_BLUR = 4.0  # px, of the patches of glass that have no depth


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """How a depth camera errs.

    Attributes:
        focal: Focal length of the depth imagers at 640 columns [px].
        baseline: Distance between the imagers [m].
        subpixel: Standard deviation of disparity [px].
        correlation: Standard deviation of the Gaussian that blurs the noise over neighbouring pixels [px].
        disparity_step: Disparity is a multiple of it [px]; 0 for none.
        scale_sigma: Standard deviation of an episode's factor on depth.
        edge_jitter: Standard deviation of an edge's place [px].
        fattening: How far near things grow over what is behind them [px].
        edge_holes: Share of the pixels at an edge that have no depth.
        speckle: Share of all other pixels that have no depth.
        transparent_holes: Share of the pixels on a transparent thing that have no depth; the rest show what is behind.
        shadow: Whether the background left of near things has no depth.
        nearest: Least depth that is measured [m].
        farthest: Largest depth that is measured [m].
    """

    focal: float = 383.0
    baseline: float = 0.05
    subpixel: float = 0.08
    correlation: float = 2.0
    disparity_step: float = 1.0 / 32.0
    scale_sigma: float = 0.003
    edge_jitter: float = 1.0
    fattening: int = 1
    edge_holes: float = 0.35
    speckle: float = 0.002
    transparent_holes: float = 0.5
    shadow: bool = True
    nearest: float = 0.175
    farthest: float = 6.0

    def __post_init__(self) -> None:
        """Check the signs."""
        for name in ("subpixel", "correlation", "disparity_step", "scale_sigma", "edge_jitter", "fattening"):
            if not getattr(self, name) >= 0:
                raise SceneError(f"{name}={getattr(self, name)}", "0 or more", "correct it")
        if not (self.focal > 0 and self.baseline > 0 and 0 < self.nearest < self.farthest):
            raise SceneError(f"{self}", "positive lengths, nearest < farthest", "correct it")

    def sigma(self, depth: np.ndarray) -> np.ndarray:
        """Return the standard deviation [m] of measured depths [m], of any shape."""
        return depth**2 * (self.subpixel / (self.focal * self.baseline))


NO_NOISE = DepthNoise(
    subpixel=0.0,
    disparity_step=0.0,
    scale_sigma=0.0,
    edge_jitter=0.0,
    fattening=0,
    edge_holes=0.0,
    speckle=0.0,
    transparent_holes=0.0,
    shadow=False,
)
"""A camera that measures true depth within its range."""


def episode_scale(noise: DepthNoise, rng: np.random.Generator) -> float:
    """Draw an episode's factor on depth."""
    return float(1.0 + noise.scale_sigma * rng.standard_normal())


def measure(
    depth: np.ndarray,
    noise: DepthNoise,
    rng: np.random.Generator,
    *,
    scale: float = 1.0,
    image_focal: float,
    behind: np.ndarray | None = None,
) -> np.ndarray:
    """Return the depth that the camera measures.

    Args:
        depth: (height, width) float32, true depth [m] of the colour image's pixels or of a window of it.
        noise: How the camera errs.
        rng: Source of the randomness; what is drawn depends on the shape alone.
        scale: The episode's factor on depth, see ``episode_scale``.
        image_focal: Focal length of the colour image [px], to which depth is aligned.
        behind: (height, width) float32, the same without transparent things [m]; where it differs from ``depth``,
            they are seen through.

    Returns:
        (height, width) float32 [m], ``HOLE`` where nothing was measured.
    """
    shape = depth.shape
    through = None
    if behind is not None:
        through = behind > depth + 1e-4
        depth = np.where(through, behind, depth)
    true_disparity = noise.focal * noise.baseline / np.maximum(depth, 1e-3)
    disparity = _move_edges(true_disparity, noise, rng)
    holes = (depth < noise.nearest) | (depth > noise.farthest)
    if noise.edge_holes > 0 or noise.speckle > 0:
        low, high = cv2.erode(disparity, _square(2)), cv2.dilate(disparity, _square(2))
        chance = smooth_noise.piece(shape, 0.0, rng)
        holes |= (high - low > 2.0 * _EDGE) & (chance < _quantile(noise.edge_holes))
        holes |= chance < _quantile(noise.speckle)
    if noise.subpixel > 0:
        disparity += smooth_noise.piece(shape, noise.correlation, rng, noise.subpixel)
    if noise.disparity_step > 0:
        disparity /= noise.disparity_step
        np.round(disparity, out=disparity)
        disparity *= noise.disparity_step
    measured = np.divide(scale * noise.focal * noise.baseline, np.maximum(disparity, 1e-3, out=disparity))
    if noise.shadow:
        holes |= shadow(true_disparity, image_focal / noise.focal)
    if through is not None and noise.transparent_holes > 0:
        patches = smooth_noise.piece(shape, _GLASS_BLUR, rng)  # whole patches of glass have no depth
        holes |= through & (patches > _quantile(1.0 - noise.transparent_holes))
    measured[holes] = HOLE
    return measured.astype(np.float32, copy=False)


def shadow(disparity: np.ndarray, pixels_per_disparity: float) -> np.ndarray:
    """Return which pixels (height, width) a nearer thing on their right hides from the second imager.

    Args:
        disparity: (height, width) [px of the depth imagers].
        pixels_per_disparity: Columns of this image for each pixel of disparity.
    """
    hidden = np.zeros(disparity.shape, bool)
    for step in _SHADOW_STEPS:
        if step < disparity.shape[1]:
            hidden[:, :-step] |= disparity[:, step:] - disparity[:, :-step] > step / pixels_per_disparity
    return hidden


def _move_edges(disparity: np.ndarray, noise: DepthNoise, rng: np.random.Generator) -> np.ndarray:
    """Let edges tremble and near things grow; the result is a new array."""
    disparity = moved = disparity.astype(np.float32)
    if noise.edge_jitter > 0:
        rows, columns = disparity.shape
        u, v = (smooth_noise.piece((rows, columns), _JITTER_BLUR, rng, noise.edge_jitter) for _ in range(2))
        u += np.arange(columns, dtype=np.float32)
        v += np.arange(rows, dtype=np.float32)[:, None]
        moved = cv2.remap(disparity, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    if noise.fattening:
        moved = cv2.dilate(moved, _square(noise.fattening))
    return np.where(np.abs(moved - disparity) > _EDGE, moved, disparity)  # slanted faces stay


def _square(reach: int) -> np.ndarray:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _quantile(share: float) -> float:
    """Return the number below which a share of a normal distribution lies."""
    if share <= 0.0 or share >= 1.0:
        return math.copysign(math.inf, share - 0.5)
    return NormalDist().inv_cdf(share)
