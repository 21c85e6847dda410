"""The head's D435 as geometry: points in front of the lens -> pixels, neck angles -> the camera's place on the torso.

Two frames at the same point. ``head_camera`` has x forward, y left, z up, as everywhere else in this package.
``optical`` has x right, y down, z forward, as image processing has it. A pixel (u, v) is the middle of column u of row
v, so the first one's middle is (0, 0).
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.robot import neck

T_OPTICAL_CAMERA = poses.from_rotation(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
"""Pose of the frame ``head_camera`` in the frame ``optical``."""

T_CAMERA_OPTICAL = poses.invert(T_OPTICAL_CAMERA)
"""Pose of the frame ``optical`` in the frame ``head_camera``."""


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Attributes:
        width: Columns [px].
        height: Rows [px].
        focal: Focal length, the same both ways [px].
        center_u: Column of the optical axis [px].
        center_v: Row of the optical axis [px].
    """

    width: int
    height: int
    focal: float
    center_u: float
    center_v: float

    def __post_init__(self) -> None:
        """Check the sizes."""
        if self.width < 1 or self.height < 1 or not self.focal > 0:
            raise SceneError(
                f"a camera of {self.width}x{self.height} px with focal length {self.focal}", "more than 0", "raise it"
            )

    def project(self, p_optical: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3) in the frame ``optical`` [m]; their depth must not be 0."""
        uv = p_optical[..., :2] / p_optical[..., 2:] * self.focal
        return uv + np.array([self.center_u, self.center_v])

    def unproject(self, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the points (..., 3) [m] in the frame ``optical`` of pixels (..., 2) at depths (...) along the axis."""
        rays = (uv - np.array([self.center_u, self.center_v])) / self.focal
        return np.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)

    def scaled(self, factor: float) -> "Intrinsics":
        """Return the same camera with a focal length that is wrong by a factor, as after a poor calibration."""
        return replace(self, focal=self.focal * factor)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) the camera matrix K."""
        return np.array([[self.focal, 0.0, self.center_u], [0.0, self.focal, self.center_v], [0.0, 0.0, 1.0]])


def head_intrinsics(width: int = neck.CAMERA_WIDTH, height: int = neck.CAMERA_HEIGHT) -> Intrinsics:
    """Return the head camera's intrinsics for images of a size [px]; its vertical field of view is the D435's."""
    return Intrinsics(
        width=width,
        height=height,
        focal=height / (2.0 * math.tan(math.radians(neck.CAMERA_FOVY) / 2.0)),
        center_u=(width - 1) / 2.0,
        center_v=(height - 1) / 2.0,
    )


def torso_camera(neck_positions: np.ndarray) -> np.ndarray:
    """Return ``T_torso_camera`` (..., 4, 4), the pose of ``head_camera`` on the torso.

    Args:
        neck_positions: (..., 2) yaw and pitch [rad].
    """
    yaw, pitch = neck_positions[..., 0], neck_positions[..., 1]
    zero = np.zeros_like(yaw)
    R_yaw = poses.rotation_from_rpy(np.stack([zero, zero, yaw], axis=-1))
    R_pitch = poses.rotation_from_rpy(np.stack([zero, pitch, zero], axis=-1))
    T_torso_yaw = poses.from_rotation(R_yaw, np.array(neck.YAW_POSITION))
    T_yaw_pitch = poses.from_rotation(R_pitch, np.array(neck.PITCH_POSITION))
    return T_torso_yaw @ T_yaw_pitch @ poses.pose(np.array(neck.LENS_POSITION))


@dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle of an image: the region of interest.

    Attributes:
        left: First column [px].
        top: First row [px].
        width: Columns [px].
        height: Rows [px].
    """

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the rectangle in the whole image."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def slices_in(self, window: "Window") -> tuple[slice, slice]:
        """Rows and columns of the rectangle in a larger one that holds it."""
        top, left = self.top - window.top, self.left - window.left
        return slice(top, top + self.height), slice(left, left + self.width)

    @property
    def corner(self) -> np.ndarray:
        """(2,) column and row of the first pixel."""
        return np.array([self.left, self.top], dtype=np.float64)


def whole(intrinsics: Intrinsics) -> Window:
    """Return the window of the whole image."""
    return Window(left=0, top=0, width=intrinsics.width, height=intrinsics.height)


def window_of(mask: np.ndarray, window: Window) -> Window | None:
    """Return the smallest window that holds the pixels of a mask (height, width) bool of a window; None for none."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return Window(left=window.left + left, top=window.top + top, width=width, height=height) if width else None


def window_around(uv: np.ndarray, margin: float, intrinsics: Intrinsics, least: int = 48) -> Window | None:
    """Return the smallest window that holds pixels and a margin, or None where all of it is outside the image.

    Args:
        uv: (n, 2) pixels.
        margin: On each side [px].
        intrinsics: The image it lies in.
        least: Least width and height [px], where the image has as many.
    """
    low, high = uv.min(axis=0) - margin, uv.max(axis=0) + margin
    size = np.array([intrinsics.width, intrinsics.height])
    if not (np.isfinite(low).all() and np.isfinite(high).all()) or (high < 0).any() or (low > size - 1).any():
        return None
    widen = np.maximum(least - (high - low), 0.0) / 2.0
    first = np.clip(np.floor(low - widen), 0, size - 1).astype(int)
    last = np.clip(np.ceil(high + widen), first, size - 1).astype(int)
    width, height = (last - first + 1).tolist()
    return Window(left=int(first[0]), top=int(first[1]), width=width, height=height)
