"""What a perceiver said and what was true, frame by frame -> the error model that fits both best."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.errors import SceneError
from gym_demohlm.perception.error_model import DISTANCE, HIDDEN, Channel, ErrorModel, ObjectErrors
from gym_demohlm.perception.model import ray_frame
from gym_demohlm.task import ObjectSpec, Task

SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Of the frames, whose quantiles the table of lengths follows."""
_EXPONENTS = (-1.0, 3.0)  # of ``s``: beyond them, few frames would speak for many
_LEAST_FRAMES = 20
_APART = 30  # frames after which only an episode's bias is common to two errors
_SMALLEST = 1e-6  # m or rad


@dataclass(frozen=True, kw_only=True)
class ErrorTrack:
    """Errors of a perceiver in one episode of T frames, for k objects.

    Attributes:
        distance: (T, k) of the object from the camera [m].
        visible: (T, k) share by ``Visibility``.
        valid: (T, k) whether the frame showed it.
        shift: (T, k, 3) error of its place in the frame of the ray to it [m].
        turn: (T, k, 3) error of its orientation in that frame [rad]; of a round object's axis alone.
    """

    distance: np.ndarray
    visible: np.ndarray
    valid: np.ndarray
    shift: np.ndarray
    turn: np.ndarray


def pose_errors(told: np.ndarray, truth: np.ndarray, entry: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts (n, 3) [m] and turns (n, 3) [rad] in the frames of the rays, the least of those that look the same.

    Args:
        told: (n, 4, 4) poses in the frame ``head_camera``.
        truth: (n, 4, 4) true ones.
        entry: Says which turns look the same.
    """
    R_ray_camera = ray_frame(truth[:, :3, 3]).swapaxes(1, 2)
    shift = np.einsum("nij,nj->ni", R_ray_camera, told[:, :3, 3] - truth[:, :3, 3])
    if entry.symmetry == "any":
        axis, true_axis = told[:, :3, 2], truth[:, :3, 2]
        cross = np.cross(true_axis, axis)
        sine = np.linalg.norm(cross, axis=1, keepdims=True)
        angle = np.arctan2(sine, (axis * true_axis).sum(axis=1, keepdims=True))
        turn = cross / np.maximum(sine, 1e-12) * angle
    else:
        same = [truth[:, :3, :3] @ poses.planar(0.0, 0.0, yaw)[:3, :3] for yaw in entry.symmetry]
        turns = np.stack([poses.rotation_vector(told[:, :3, :3] @ R.swapaxes(1, 2)) for R in same])
        best = np.argmin(np.linalg.norm(turns, axis=-1), axis=0)
        turn = turns[best, np.arange(len(told))]
    return shift, np.einsum("nij,nj->ni", R_ray_camera, turn)


def fit_model(task: Task, tracks: Sequence[ErrorTrack], origin: dict[str, Any]) -> ErrorModel:
    """Return the model that fits episodes.

    Args:
        task: The task.
        tracks: One an episode.
        origin: What they were, in words.

    Raises:
        SceneError: An object was seen in too few frames.
    """
    objects = []
    for k, entry in enumerate(task.objects):
        seen = sum(int(track.valid[:, k].sum()) for track in tracks)
        if seen < _LEAST_FRAMES:
            raise SceneError(f"{entry.name} in {seen} frames", f"{_LEAST_FRAMES} or more", "give more --num-episodes")
        odds = {
            f"{change}_when_{how}": _odds(tracks, k, change, how)
            for change in ("lost", "found")
            for how in ("seen", "hidden")
        }
        objects.append(
            ObjectErrors(
                name=entry.name,
                shift=_channel([track.shift[:, k] for track in tracks], tracks, k),
                turn=_channel([track.turn[:, k] for track in tracks], tracks, k),
                **odds,
                found_first=_first_odds(tracks, k),
            )
        )
    return ErrorModel(task=task.name, origin=origin, objects=tuple(objects))


def _odds(tracks: Sequence[ErrorTrack], k: int, change: str, how: str) -> float:
    """Return how often an object's state changes from one frame to the next, 0.5 where it never was so."""
    counts = np.zeros(2)
    for track in tracks:
        valid, hidden = track.valid[:, k], track.visible[1:, k] < HIDDEN
        before = valid[:-1] if change == "lost" else ~valid[:-1]
        chosen = before & (hidden if how == "hidden" else ~hidden)
        counts += chosen.sum(), (chosen & (valid[1:] != valid[:-1])).sum()
    return float(counts[1] / counts[0]) if counts[0] else 0.5


def _first_odds(tracks: Sequence[ErrorTrack], k: int) -> float | None:
    """Return how often a frame shows an object that none has shown yet and nothing hides; None where none waited."""
    found = waited = 0
    for track in tracks:
        valid, hidden = track.valid[:, k], track.visible[:, k] < HIDDEN
        first = int(np.argmax(valid)) if valid.any() else len(valid)
        waiting = ~hidden[1 : first + 1]
        waited += int(waiting.sum())
        found += int(0 < first < len(valid) and not hidden[first])
    return found / waited if waited else None


def _channel(errors: Sequence[np.ndarray], tracks: Sequence[ErrorTrack], k: int) -> Channel:
    """Fit one kind of errors (T, 3) an episode."""
    valid = [track.valid[:, k] for track in tracks]
    distance = np.concatenate([track.distance[keep, k] for track, keep in zip(tracks, valid, strict=True)])
    visible = np.concatenate([track.visible[keep, k] for track, keep in zip(tracks, valid, strict=True)])
    pooled = np.concatenate([each[keep] for each, keep in zip(errors, valid, strict=True)])
    power, rate = _scale_exponents(np.linalg.norm(pooled, axis=1), distance, visible)
    s = (distance / DISTANCE) ** power * np.exp(rate * (1.0 - visible))
    scaled = pooled / s[:, None]
    offset = np.median(scaled, axis=0)
    scaled = scaled - offset
    axes = _axes(scaled)
    white = scaled @ np.linalg.inv(axes).T
    lengths = np.linalg.norm(white, axis=1)
    normal_lengths = _normal_length(np.clip(np.array(SHARES), 0.0, 1.0 - 0.5 / len(lengths)))
    error_lengths = np.maximum.accumulate(np.quantile(lengths, SHARES))
    ranks = (np.argsort(np.argsort(lengths)) + 0.5) / len(lengths)
    g = white / np.maximum(lengths, _SMALLEST)[:, None] * _normal_length(ranks)[:, None]
    parts = np.split(g, np.cumsum([int(keep.sum()) for keep in valid])[:-1])
    frames = [np.flatnonzero(keep) for keep in valid]
    far, near = _common(parts, frames, _APART), _common(parts, frames, 1)
    share = float(np.clip(far, 0.0, 0.95))
    correlation = float(np.clip((near - share) / (1.0 - share), 0.0, 0.995))
    return Channel(
        distance_power=round(power, 4),
        hidden_rate=round(rate, 4),
        offset=np.round(offset, 8).tolist(),
        axes=np.round(axes, 6).tolist(),
        normal_lengths=np.round(normal_lengths, 6).tolist(),
        error_lengths=np.round(error_lengths, 8).tolist(),
        bias_share=round(share, 4),
        correlation=round(correlation, 4),
    )


def _scale_exponents(lengths: np.ndarray, distance: np.ndarray, visible: np.ndarray) -> tuple[float, float]:
    """Return p and q of ``s`` by least squares of logarithms, held back where frames differ little."""
    columns = np.stack([np.log(distance / DISTANCE), 1.0 - visible], axis=1)
    columns = columns - columns.mean(axis=0)
    target = np.log(np.maximum(lengths, _SMALLEST))
    ridge = 0.01 * len(lengths) * np.diag([0.05, 0.05])
    found = np.linalg.solve(columns.T @ columns + ridge, columns.T @ (target - target.mean()))
    power, rate = np.clip(found, *_EXPONENTS).tolist()
    return power, rate


def _axes(errors: np.ndarray) -> np.ndarray:
    """Return A (3, 3): the shape of the errors' distribution without their lengths, of mean square 1 an axis."""
    direction = errors / np.maximum(np.linalg.norm(errors, axis=1, keepdims=True), _SMALLEST)
    shape = 3.0 * direction.T @ direction / len(direction) + 0.02 * np.eye(3)
    for _ in range(20):  # Tyler's estimate, which tails do not move
        white = np.einsum("ni,ij,nj->n", direction, np.linalg.inv(shape), direction)
        shape = 3.0 * (direction / white[:, None]).T @ direction / len(direction)
        shape = 3.0 * shape / np.trace(shape) + 0.02 * np.eye(3)
    return np.linalg.cholesky(shape)


def _common(parts: Sequence[np.ndarray], frames: Sequence[np.ndarray], apart: int) -> float:
    """Return the mean product of numbers (T, 3) that lie at least (1: exactly) so many frames apart in an episode."""
    total = count = 0.0
    for g, at in zip(parts, frames, strict=True):
        gap = at[None, :] - at[:, None]
        chosen = gap == 1 if apart == 1 else gap >= apart
        total += float(((g @ g.T) * chosen).sum()) / 3.0
        count += float(chosen.sum())
    return total / count if count else 0.0


_LENGTHS = np.linspace(0.0, 6.0, 2001)
_BELOW = np.array([math.erf(x / math.sqrt(2)) - math.sqrt(2 / math.pi) * x * math.exp(-x * x / 2) for x in _LENGTHS])


def _normal_length(share: np.ndarray) -> np.ndarray:
    """Return the length below which a share of three-dimensional standard normal vectors lies."""
    return np.interp(share, _BELOW, _LENGTHS)
