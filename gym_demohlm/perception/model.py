"""Exact poses -> what a tracker would say of them by a fitted error model: nothing is drawn, so it costs little.

The model is fitted to ``rgbd`` (``demohlm fit-perception``) and lies in ``fitted/`` for each task of the package. It is
fitted to looks 0.1 s apart. Looks at other times are those of the same process, however often they come.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.error_model import HIDDEN, Channel, ErrorModel, fitted_path, read_model
from gym_demohlm.perception.estimate import PERCEPTION_STREAM, UNSEEN, PoseEstimate
from gym_demohlm.perception.exact import ExactPerceiver
from gym_demohlm.perception.look_clock import LookClock
from gym_demohlm.perception.visibility import Visibility
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT

_OWN_STREAM = 2


class ModelPerceiver:
    """Adds fitted errors to exact poses.

    Args:
        task: The task.
        num_worlds: N of the simulation.
        path: File of the model; the packaged one of the task by default.
        model: The model itself, instead of a file.

    Attributes:
        share: (N,) errors of each world over the fitted ones; 0 for exact poses, which are never lost.

    Raises:
        SceneError: There is no such file, or it is damaged or of another task.
    """

    def __init__(self, task: Task, num_worlds: int, path: Path | None = None, model: ErrorModel | None = None) -> None:
        self.model = model or read_model(path or fitted_path(task), task)
        self._exact, self._clock = ExactPerceiver(), LookClock(num_worlds)
        self._visibility: Visibility | None = None
        k = len(task.objects)
        self.share = np.ones(num_worlds)
        self._rngs: list[np.random.Generator | None] = [None] * num_worlds
        self._bias = np.zeros((num_worlds, k, 2, 3))  # of shifts and of turns
        self._noise = np.zeros((num_worlds, k, 2, 3))
        self._valid = np.zeros((num_worlds, k), bool)
        self._age = np.full((num_worlds, k), np.inf)
        self._held = np.tile(np.eye(4), (num_worlds, k, 1, 1))  # in the world, as odometry would have it
        self._begun = np.zeros(num_worlds, bool)

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Forget everything about some worlds; draw their biases."""
        self._clock.begin(rows)
        for row, seed in zip(rows, seeds, strict=True):
            rng = self._rngs[row] = np.random.default_rng([PERCEPTION_STREAM, _OWN_STREAM, seed])
            self._bias[row] = rng.standard_normal(self._bias.shape[1:])
            self._begun[row], self.share[row] = False, 1.0

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Return poses with errors in some worlds (n,)."""
        rows = np.asarray(rows)
        if self._visibility is None:
            self._visibility = Visibility(sim)
        for row in rows:
            if self._rngs[row] is None:
                self.begin(np.array([row]), [int(row)])
        steps = self._clock.steps(sim, rows)
        odds = self._drawn(rows, steps)
        exact = self._exact.observe(sim, rows).T_camera_object
        visible = self._visibility.shares(sim, rows, exact)
        shown = self._chain(rows, visible, odds, steps)
        T_world_camera = sim.pose("head_camera")[rows]
        told = self._disturbed(rows, exact, visible)
        held = poses.invert(T_world_camera)[:, None] @ self._held[rows]
        unseen = np.isinf(self._age[rows]) & ~shown
        T = np.where(shown[..., None, None], told, np.where(unseen[..., None, None], poses.pose(UNSEEN), held))
        self._held[rows] = T_world_camera[:, None] @ T
        self._valid[rows], self._begun[rows] = shown, True
        self._age[rows] = np.where(shown, 0.0, self._age[rows] + STEP_DT * steps[:, None])
        return PoseEstimate(
            T_camera_object=T, valid=shown, age_s=self._age[rows].copy(), inliers=shown.astype(np.float64)
        )

    def close(self) -> None:
        """Do nothing: it holds nothing."""

    def _drawn(self, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Draw what a frame needs, each world from its own stream, and move the noise on.

        Args:
            rows: (n,) the worlds.
            steps: (n,) time since their last frame, in steps of 0.1 s.

        Returns:
            (n, k) of 0 to 1.
        """
        normal = np.empty((len(rows), *self._noise.shape[1:]))
        odds = np.empty((len(rows), self._valid.shape[1]))
        for place, row in enumerate(rows):
            rng = self._rngs[row]
            assert rng is not None  # its episode has begun
            normal[place], odds[place] = rng.standard_normal(normal.shape[1:]), rng.random(odds.shape[1])
        new = ~self._begun[rows]
        self._age[rows[new]] = np.inf
        for k, entry in enumerate(self.model.objects):
            for kind, channel in enumerate((entry.shift, entry.turn)):
                keep = np.where(new, 0.0, _power(channel.correlation, steps))[:, None]
                self._noise[rows, k, kind] = (
                    keep * self._noise[rows, k, kind] + np.sqrt(1 - keep**2) * normal[:, k, kind]
                )
        return odds

    def _chain(self, rows: np.ndarray, visible: np.ndarray, odds: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return which objects (n, k) the frame shows, a time (n,) after the last one, in steps of 0.1 s."""
        hidden, shown = visible < HIDDEN, np.empty(visible.shape, bool)
        for k, entry in enumerate(self.model.objects):
            lost = np.where(hidden[:, k], entry.lost_when_hidden, entry.lost_when_seen)
            found = np.where(hidden[:, k], entry.found_when_hidden, entry.found_when_seen)
            lost, found = _odds_after(lost, found, steps)
            if entry.found_first is not None:
                first = np.isinf(self._age[rows, k]) & ~hidden[:, k]
                found = np.where(first, 1.0 - _power(1.0 - entry.found_first, steps), found)
            before = self._valid[rows, k] | ~self._begun[rows]
            shown[:, k] = np.where(before, odds[:, k] >= lost, odds[:, k] < found)
        return (shown & (visible > 0.0)) | (self.share[rows] == 0.0)[:, None]

    def _disturbed(self, rows: np.ndarray, exact: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return poses (n, k, 4, 4) with shifts and turns."""
        told = exact.copy()
        for k, entry in enumerate(self.model.objects):
            place = exact[:, k, :3, 3]
            distance = np.linalg.norm(place, axis=1)
            R_camera_ray = ray_frame(place)
            shift, turn = (
                (R_camera_ray * self._errors(channel, rows, k, kind, distance, visible[:, k])[:, None, :]).sum(axis=-1)
                for kind, channel in enumerate((entry.shift, entry.turn))
            )
            told[:, k, :3, 3] += shift
            told[:, k, :3, :3] = poses.rotation_from_vector(turn) @ exact[:, k, :3, :3]
        return told

    def _errors(
        self, channel: Channel, rows: np.ndarray, k: int, kind: int, distance: np.ndarray, visible: np.ndarray
    ) -> np.ndarray:
        share = channel.bias_share
        g = np.sqrt(share) * self._bias[rows, k, kind] + np.sqrt(1.0 - share) * self._noise[rows, k, kind]
        return self.share[rows, None] * channel.errors(g, distance, visible)


def _power(share: float, steps: np.ndarray) -> np.ndarray:
    """Return what is left of a share of each step after times (n,) in steps; exactly the share after one."""
    return np.where(steps == 1.0, share, max(share, 0.0) ** steps)


def _odds_after(lost: np.ndarray, found: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the odds (n,) of losing and of finding an object after times (n,) in steps, from those of one step (n,).

    However often one looks, the object is seen as large a share of the time. What is lost and found is forgotten as
    fast, too; where each step is likelier to change than to stay, looks at other times are independent.
    """
    both = lost + found
    kept = np.maximum(1.0 - both, 0.0) ** steps
    change = np.where(steps == 1.0, 1.0, (1.0 - kept) / np.maximum(both, 1e-12))
    return change * lost, change * found


def ray_frame(p_camera: np.ndarray) -> np.ndarray:
    """Return rotations (n, 3, 3) whose x axis points from the camera at points (n, 3) and whose y axis is level."""
    x = p_camera / np.maximum(np.linalg.norm(p_camera, axis=1, keepdims=True), 1e-9)
    y = np.stack([-x[:, 1], x[:, 0], np.zeros(len(x))], axis=1)
    y = y / np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
    return np.stack([x, y, np.cross(x, y)], axis=-1)
