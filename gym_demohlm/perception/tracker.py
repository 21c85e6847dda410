"""Depth and masks, frame by frame -> the pose of one object: register, follow, notice when it is lost, register again.

Between frames the object is expected where it was in odometry coordinates. Where the mask says otherwise the guess is
moved to the mask first: at 10 Hz the image moves too far for a fit alone. A pose is believed only if it explains
silhouette and depth. An object that is lost, or not seen, is held in odometry coordinates and its age grows. One that
was found while the image's border cut it off is looked for anew once it is in full view.

What no hand is near stays where it is: frames are averaged, as far as odometry can be trusted. What a hand is near may
have moved with the hand, or on its own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception import fit, placement
from gym_demohlm.perception.camera import Intrinsics, Window
from gym_demohlm.perception.d435 import DepthNoise
from gym_demohlm.perception.meshes import ObjectMesh
from gym_demohlm.perception.starts import starts

LEAST_PIXELS = 40  # a smaller mask shows nothing
_ROUGH_ITERATIONS, _FINE_ITERATIONS, _TRACK_ITERATIONS = 4, 8, 6
_ROUGHLY_FITTED, _REFINED = 8, 3  # of the starts
_BELIEVED_IOU, _BELIEVED_INLIERS = 0.55, 0.45
_GOOD_IOU, _GOOD_INLIERS = 0.85, 0.85
_SETTLED = 20  # frames, after which those that come before it is in full view are over
_FORGET_S = 0.5  # after which a fit from where it was is not tried
_BEST_SCORE = fit.Quality(inliers=1.0, iou=1.0).score
_PREFERENCE = 0.05  # by which a pose from nowhere must explain the frame better
_TURNED_AWAY = math.radians(100.0)  # the largest angle, at first, from how an object roughly lies
_SCALE_FLOOR, _SCALE_DRIFT = 1e-5, 0.05  # least doubt about depth's factor; share of the doubt that comes back a frame
_RESTING = 0.0005, math.radians(0.1), 0.03  # m and rad a frame, share of the camera's motion that odometry misses
_MOVING, _TURNING = 0.008, math.radians(3.0)  # m and rad a frame: more than a resting object seems to move
_HANDLED = 0.01, math.radians(6.0)  # m and rad a frame, by which what a hand is near moves otherwise than foreseen
_SURPRISE = 16.0  # squared deviations of seven numbers: chance exceeds it once in forty frames


@dataclass(frozen=True, kw_only=True)
class Track:
    """What is known of an object after a frame.

    Attributes:
        T_odom_object: (4, 4).
        valid: Whether this frame showed it.
        age_s: Time since a frame did [s]; 0 where this one does.
        inliers: Share of depth pixels that lie on the object, in the last frame that showed it.
        iou: Agreement of silhouette and mask in that frame.
        registered: Whether this frame found it anew.
    """

    T_odom_object: np.ndarray
    valid: bool
    age_s: float
    inliers: float
    iou: float
    registered: bool = False


class Tracker:
    """Follows one object.

    Args:
        mesh: Its shape.
        intrinsics: Of the images, as far as the robot knows them.
        noise: What the depth camera's noise is taken to be.

    Attributes:
        shape: The object's shape as arrays.
        track: What is known of it; None before it was seen.
        intrinsics: Of the images, as far as the robot knows them.
    """

    def __init__(self, mesh: ObjectMesh, intrinsics: Intrinsics, noise: DepthNoise | None = None) -> None:
        self.shape = fit.Shape(mesh)
        self.track: Track | None = None
        self.intrinsics, self._noise = intrinsics, noise or DepthNoise()
        self._scale_sigma = max(self._noise.scale_sigma, _SCALE_FLOOR)
        self._unknown = np.diag([0.0] * 6 + [self._scale_sigma**-2])
        self._last = fit.Fit(np.eye(4), 1.0, self._unknown)
        self._T_odom_optical = np.eye(4)  # when it was last seen
        self._moving, self._motion = False, np.eye(4)  # in odometry coordinates, from frame to frame
        self._found_in_part = False  # registered as the image's border cut it off; to be done again in full view
        self._looks = 0  # that showed it since it was found

    def expected(self, T_odom_optical: np.ndarray) -> np.ndarray | None:
        """Return where the object should be, ``T_optical_object``, or None before it was seen."""
        return None if self.track is None else poses.invert(T_odom_optical) @ self.track.T_odom_object

    @property
    def was_whole(self) -> bool:
        """Whether how the object lies is known: it was seen, and not only in part."""
        return self.track is not None and not self._found_in_part

    @property
    def is_settled(self) -> bool:
        """Whether it was seen often since it was found, so that one more frame tells little."""
        return self._looks >= _SETTLED

    def update(
        self,
        depth: np.ndarray,
        mask: np.ndarray,
        window: Window,
        T_odom_optical: np.ndarray,
        dt: float,
        hand_motions: Sequence[np.ndarray] = (),
        hiders: np.ndarray | None = None,
        R_odom_object: np.ndarray | None = None,
        T_odom_expected: np.ndarray | None = None,
    ) -> Track | None:
        """Look at a frame.

        Args:
            depth: (height, width) float32 of the window [m], 0 where nothing was measured.
            mask: (height, width) bool of the window.
            window: Part of the image.
            T_odom_optical: The camera's pose in odometry coordinates, z up.
            dt: Time since the last frame [s].
            hand_motions: (4, 4) rigid motions in odometry coordinates, since the last frame, of the hands that are near
                the object.
            hiders: (height, width) bool of the window, known things that may hide the object: the robot, other objects.
            R_odom_object: (3, 3) how the object lies, for the first time, within a right angle about the vertical;
                upright by default.
            T_odom_expected: (4, 4) where the object is, as far as other things tell, as long as it was not seen whole.

        Returns:
            What is known now; None as long as it has never been seen.
        """
        view = fit.make_view(depth, mask, window, self.intrinsics, self._noise, hiders)
        if view.num_pixels < LEAST_PIXELS:
            return self._held(dt)
        result, quality, registered, whole = None, None, False, placement.is_whole(view)
        if self.track is not None and self.track.age_s <= _FORGET_S:
            result, quality = self._follow(view, T_odom_optical, hand_motions)
        if quality is None or not _believed(quality) or (whole and self._found_in_part):
            found, found_quality = self.register(view, T_odom_optical, R_odom_object, T_odom_expected)
            if quality is None or found_quality.score > quality.score + _PREFERENCE:
                result, quality, registered = found, found_quality, True
        if result is None or not _believed(quality):
            return self._held(dt)
        self._found_in_part = (registered or self._found_in_part) and not whole and T_odom_expected is None
        self._looks = 1 if registered else self._looks + 1
        T_odom_object = T_odom_optical @ result.T
        self._moving, self._motion = False, np.eye(4)
        if self.track is not None and self.track.valid and not registered:
            motion = T_odom_object @ poses.invert(self.track.T_odom_object)
            way = np.linalg.norm(T_odom_object[:3, 3] - self.track.T_odom_object[:3, 3])
            if way > _MOVING or np.linalg.norm(poses.rotation_vector(motion[:3, :3])) > _TURNING:
                self._moving, self._motion = True, motion
        self._last, self._T_odom_optical = result, T_odom_optical
        self.track = Track(
            T_odom_object=T_odom_object,
            valid=True,
            age_s=0.0,
            inliers=quality.inliers,
            iou=quality.iou,
            registered=registered,
        )
        return self.track

    def skip(self, dt: float) -> None:
        """Let a frame pass without a look: what was seen counts as seen, and what was not grows older.

        Args:
            dt: Time since the last frame [s].
        """
        if self.track is not None and not self.track.valid:
            self._held(dt)

    def settle(self, T_odom_optical: np.ndarray, R_odom_object: np.ndarray) -> None:
        """Choose anew among the poses that look the same, if another lies twice as near to how the object lies.

        Args:
            T_odom_optical: The camera's pose in odometry coordinates.
            R_odom_object: (3, 3) how it lies.
        """
        if self.track is None:
            return
        T = self._like(poses.invert(T_odom_optical) @ self.track.T_odom_object, T_odom_optical[:3, :3].T, R_odom_object)
        T_odom_object = T_odom_optical @ T
        if _angle(T_odom_object, R_odom_object) > 0.5 * _angle(self.track.T_odom_object, R_odom_object):
            return
        self.track = replace(self.track, T_odom_object=T_odom_object)
        self._last = replace(self._last, T=T)

    def _held(self, dt: float) -> Track | None:
        """Keep what is known."""
        if self.track is not None:
            last = self.track
            self.track = Track(
                T_odom_object=last.T_odom_object,
                valid=False,
                age_s=last.age_s + dt,
                inliers=last.inliers,
                iou=last.iou,
            )
        return self.track

    def _follow(
        self, view: fit.View, T_odom_optical: np.ndarray, hand_motions: Sequence[np.ndarray]
    ) -> tuple[fit.Fit, fit.Quality]:
        """Fit from where the object should be, and from where the mask is if that is elsewhere."""
        still = self.expected(T_odom_optical)
        assert still is not None
        resting = not self._moving and (self.shape.mesh.fixed or not hand_motions)
        moved = placement.moved_to_mask(self.shape, still, view)
        if resting and (moved is None or self.shape.mesh.fixed):
            prior = self._prior(still, T_odom_optical, handled=False)
            best = fit.fit(self.shape, still, view, prior, _TRACK_ITERATIONS)
            quality = fit.assess(self.shape, best.T, view, best.scale)
            if _good(quality) and fit.surprise(best, prior) < _SURPRISE:
                return best, quality
        T_optical_odom = poses.invert(T_odom_optical)
        motions = [*hand_motions, *([self._motion] if self._moving else [])]
        guesses = [still, *(T_optical_odom @ motion @ T_odom_optical @ still for motion in motions)]
        guesses.sort(key=lambda guess: -fit.assess(self.shape, guess, view, self._last.scale).score)
        moved = placement.moved_to_mask(self.shape, guesses[0], view)
        best, quality = self._last, fit.Quality(0.0, 0.0)
        for guess in guesses[:3] if moved is None else [moved, *guesses[:2]]:
            prior = self._prior(guess, T_odom_optical, handled=True)
            result = fit.fit(self.shape, guess, view, prior, _TRACK_ITERATIONS)
            result_quality = fit.assess(self.shape, result.T, view, result.scale)
            if result_quality.score > quality.score:
                best, quality = result, result_quality
            if _good(quality):
                break
        return best, quality

    def _prior(self, guess: np.ndarray, T_odom_optical: np.ndarray, handled: bool) -> fit.Prior:
        """Return what is known of the object before a frame, if it is where it is guessed to be."""
        motion = poses.invert(self._T_odom_optical) @ T_odom_optical
        length, turn = np.linalg.norm(motion[:3, 3]), np.linalg.norm(poses.rotation_vector(motion[:3, :3]))
        to_now = np.eye(7)
        to_now[:3, :3] = to_now[3:6, 3:6] = motion[:3, :3].T
        deviation = np.zeros(7)
        deviation[:3] = _RESTING[0] + _RESTING[2] * (length + guess[2, 3] * turn)
        deviation[3:6] = _RESTING[1] + _RESTING[2] * turn
        if handled:
            deviation[:3], deviation[3:6] = _HANDLED
        deviation[6] = _SCALE_DRIFT * self._scale_sigma
        covariance = np.linalg.inv(self._last.information + 1e-3 * np.eye(7))
        covariance = to_now @ covariance @ to_now.T + np.diag(deviation**2)
        return fit.Prior(guess, self._last.scale, np.linalg.inv(covariance))

    def register(
        self,
        view: fit.View,
        T_odom_optical: np.ndarray,
        R_odom_object: np.ndarray | None = None,
        T_odom_expected: np.ndarray | None = None,
    ) -> tuple[fit.Fit, fit.Quality]:
        """Find the object anew, from many starts and, if it was seen before, from where it was.

        Of two poses that explain the frame almost alike, the one where it was is taken: most things are still there.
        Furniture that the image's border cuts off is nowhere else: a part of it looks like other parts.

        Args:
            view: Depth and mask.
            T_odom_optical: The camera's pose in odometry coordinates, z up.
            R_odom_object: (3, 3) roughly how the object lies, if it was never seen; upright by default.
            T_odom_expected: (4, 4) where it is, as far as other things tell, if it was never seen whole.

        Returns:
            Of all poses that look the same the one that lies most like the default, and its quality.
        """
        R_optical_odom = T_odom_optical[:3, :3].T
        still = None
        if self.was_whole:
            assert self.track is not None
            T_odom_expected = self.track.T_odom_object
        if T_odom_expected is not None:
            R_odom_object = T_odom_expected[:3, :3]
            still = self._fitted_from(poses.invert(T_odom_optical) @ T_odom_expected, view, T_odom_optical)
            if still[1].score > _BEST_SCORE - _PREFERENCE:
                return still  # no other pose explains the frame better by enough
            if self.shape.mesh.fixed and not placement.is_whole(view):
                return still
        turned = [R_optical_odom @ start for start in starts(R_odom_object, still is not None)]
        placed = [T for R_optical_object in turned for T in placement.placed(self.shape, R_optical_object, view)]
        rough = [
            fit.fit(self.shape, T, view, self._nothing(T), _ROUGH_ITERATIONS, reach=50).T
            for T in self._best(placed, view, _ROUGHLY_FITTED)
        ]
        best, best_quality = self._last, fit.Quality(0.0, 0.0)
        for T in self._best(rough, view, _REFINED):
            result = fit.fit(self.shape, T, view, self._nothing(T), _FINE_ITERATIONS, reach=12)
            quality = fit.assess(self.shape, result.T, view, result.scale)
            result = replace(result, T=self._like(result.T, R_optical_odom, R_odom_object))
            if still is None and R_odom_object is not None:
                if _angle(R_optical_odom.T @ result.T[:3, :3], R_odom_object) > _TURNED_AWAY:
                    continue
            if quality.score > best_quality.score:
                best, best_quality = result, quality
        if still is not None and still[1].score > best_quality.score - _PREFERENCE:
            return still
        return best, best_quality

    def _fitted_from(self, T: np.ndarray, view: fit.View, T_odom_optical: np.ndarray) -> tuple[fit.Fit, fit.Quality]:
        """Fit from where the object should be, ``T_optical_object``."""
        result = fit.fit(self.shape, T, view, self._prior(T, T_odom_optical, handled=True), _FINE_ITERATIONS, reach=12)
        return result, fit.assess(self.shape, result.T, view, result.scale)

    def _best(self, candidates: Sequence[np.ndarray], view: fit.View, count: int) -> list[np.ndarray]:
        """Return the poses that explain a view best, the best one first."""
        return sorted(candidates, key=lambda T: -fit.assess(self.shape, T, view).score)[:count]

    def _nothing(self, T: np.ndarray) -> fit.Prior:
        """Return the prior of who knows the depth camera only."""
        information = self._unknown.copy()
        information[6, 6] = max(information[6, 6], self._last.information[6, 6])
        return fit.Prior(T, self._last.scale, information)

    def _like(self, T: np.ndarray, R_optical_odom: np.ndarray, R_odom_object: np.ndarray | None) -> np.ndarray:
        """Return the pose, among those that look the same, that lies most like a rough orientation, or upright."""
        turned = T[:3, :3] @ self.shape.mesh.symmetries  # (s, 3, 3)
        if R_odom_object is None or self.shape.mesh.spec.symmetry == "any":
            axis = R_optical_odom @ (np.array([0.0, 0.0, 1.0]) if R_odom_object is None else R_odom_object[:, 2])
            likeness = turned[:, :, 2] @ axis
        else:
            likeness = np.einsum("sij,ij->s", turned, R_optical_odom @ R_odom_object)
        chosen = int(np.flatnonzero(likeness > likeness.max() - 1e-3)[0])
        result = T.copy()
        result[:3, :3] = turned[chosen]
        return result


def _believed(quality: fit.Quality | None) -> bool:
    return quality is not None and quality.iou > _BELIEVED_IOU and quality.inliers > _BELIEVED_INLIERS


def _good(quality: fit.Quality) -> bool:
    return quality.iou > _GOOD_IOU and quality.inliers > _GOOD_INLIERS


def _angle(T: np.ndarray, R: np.ndarray) -> float:
    """Return the angle between two orientations [rad]; a pose counts by its orientation."""
    return float(np.linalg.norm(poses.rotation_vector(T[:3, :3] @ R.T)))
