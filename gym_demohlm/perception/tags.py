"""A grey picture with AprilTags -> the pose of what wears them.

Measured in drawn pictures with blur and noise (8 cm tags at 0.4 to 1.4 m): pupil-apriltags is off by 0.5 to 1.8 mm in
14 to 20 ms; OpenCV's detector by 1.3 to 22 mm with corners refined to subpixels, or as little as pupil's in 120 to
165 ms with its AprilTag refinement. So this uses pupil-apriltags.
"""

import atexit
import functools
from collections.abc import Sequence

import cv2
import numpy as np
from pupil_apriltags import Detector

from gym_demohlm import poses
from gym_demohlm.perception.camera import Intrinsics, Window
from gym_demohlm.perception.tag_layout import FAMILY, Tag

_AMBIGUOUS = 2.0  # ratio of reprojection errors below which either of a tag's two poses may be the true one
_LARGEST_ERROR = 2.0  # px: a pose that explains corners worse is none


@functools.cache
def _detector() -> Detector:
    """Return the detector of this process, which is never freed.

    pupil-apriltags frees a detector after the tag families that it refers to, which may end the process.
    """
    detector = Detector(families=FAMILY, nthreads=1, quad_decimate=1.0)
    atexit.register(setattr, detector, "tag_detector_ptr", None)  # its finalizer then leaves it alone
    return detector


class TagFinder:
    """Finds tags."""

    def corners(self, grey: np.ndarray, window: Window) -> dict[int, np.ndarray]:
        """Return the corners (4, 2) [px of the whole image] of each tag, counter-clockwise from its lower left.

        Args:
            grey: (height, width) uint8 of the window.
            window: Where in the image it lies.
        """
        found = {}
        for entry in list(_detector().detect(np.ascontiguousarray(grey))):  # pyright: ignore[reportArgumentType]
            if entry.hamming == 0:
                found[int(entry.tag_id)] = np.asarray(entry.corners) - 0.5 + window.corner  # pixel middles are whole
        return found


def object_pose(
    tags: Sequence[Tag], corners: dict[int, np.ndarray], known: Intrinsics, expected: np.ndarray | None
) -> tuple[np.ndarray, float] | None:
    """Return ``T_optical_object`` (4, 4) and the share of its tags that were found; None without any.

    Args:
        tags: Of the object.
        corners: Of the tags found, see ``TagFinder``.
        known: The camera.
        expected: (4, 4) where the object should be, to choose among the two poses of a single tag; None where unknown.
    """
    seen = [tag for tag in tags if tag.id in corners]
    if not seen:
        return None
    points = np.concatenate([tag.corners for tag in seen])
    pixels = np.concatenate([corners[tag.id] for tag in seen])
    widest = max(seen, key=lambda tag: cv2.contourArea(corners[tag.id].astype(np.float32)))
    best = _single(widest, corners[widest.id], known, expected)
    if best is None:
        return None
    vector, shift = cv2.Rodrigues(best[:3, :3])[0], best[:3, 3:].copy()
    vector, shift = cv2.solvePnPRefineLM(points, pixels, known.matrix, None, vector, shift)
    T = poses.from_rotation(cv2.Rodrigues(vector)[0], shift[:, 0])
    off = known.project(poses.transform(T, points)) - pixels
    if not np.isfinite(T).all() or T[2, 3] <= 0 or np.sqrt((off**2).sum(axis=1).mean()) > _LARGEST_ERROR:
        return None
    return T, len(seen) / len(tags)


def _single(tag: Tag, corners: np.ndarray, known: Intrinsics, expected: np.ndarray | None) -> np.ndarray | None:
    """Return the pose that one tag tells; of two that explain it about as well, the one nearest to the expected."""
    half = 0.5 * tag.edge
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])  # OpenCV's order
    count, vectors, shifts, errors = cv2.solvePnPGeneric(
        square, corners[[3, 2, 1, 0]], known.matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not count:
        return None
    T_tag_object = poses.invert(tag.T_object_tag)
    found = [
        poses.from_rotation(cv2.Rodrigues(vector)[0], shift[:, 0]) @ T_tag_object
        for vector, shift in zip(vectors, shifts, strict=True)
    ]
    if expected is None or len(found) < 2 or errors[1][0] > _AMBIGUOUS * errors[0][0]:
        return found[0]
    return max(found, key=lambda T: float((T[:3, :3] * expected[:3, :3]).sum()))
