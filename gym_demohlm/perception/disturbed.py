"""Any perceiver -> the same with a bias of an episode, lost frames and latency: for what these alone do, or as drawn.

What is old is brought to the camera's present place by odometry: a robot knows when a picture was taken. So latency
does nothing to what rests, and only what moves is told where it was. Time is that of the worlds, however often they
are looked at.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.perception.disturbance import Disturbance
from gym_demohlm.perception.estimate import PERCEPTION_STREAM, Perceiver, PoseEstimate, faults_of
from gym_demohlm.perception.look_clock import LookClock
from gym_demohlm.perception.model import ModelPerceiver
from gym_demohlm.perception.settings import PerceptionSettings
from gym_demohlm.simulation import Simulation
from gym_demohlm.timing import STEP_DT

_TURN_OF_MM = math.radians(0.2)  # a tracker that is off by 5 mm is off by about a degree
_OWN_STREAM = 1
_SAME = 1e-6  # steps


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """What a frame showed of the k objects of a world.

    Attributes:
        at: When, in steps of 0.1 s since the episode's first look.
        T_world_objects: (k, 4, 4).
        valid: (k,) see ``PoseEstimate``.
        age_s: (k,) then.
        inliers: (k,).
    """

    at: float
    T_world_objects: np.ndarray
    valid: np.ndarray
    age_s: np.ndarray
    inliers: np.ndarray


@dataclass
class _World:
    """What is remembered of one world.

    Attributes:
        rng: Of bias and lost frames.
        disturbance: What is wrong with its eyes.
        bias: Turns (k, 3, 3) and shifts (k, 3) [m] in the frame ``head_camera``; None before the first look.
        now: Time since its first look, in steps of 0.1 s.
        seen: The frame that was told last, and those after it.
    """

    rng: np.random.Generator
    disturbance: Disturbance
    bias: tuple[np.ndarray, np.ndarray] | None = None
    now: float = 0.0
    seen: deque[_Frame] = field(default_factory=deque)

    def told(self, frame: _Frame) -> _Frame:
        """Take in a new frame; returns the newest that is as old as the latency, or the oldest where none is yet."""
        self.seen.append(frame)
        latency = round(self.disturbance.latency_s / STEP_DT)
        while len(self.seen) > 1 and self.now - self.seen[1].at > latency - _SAME:
            self.seen.popleft()
        return self.seen[0]


class DisturbedPerceiver:
    """Adds bias, dropout and latency to another perceiver.

    Args:
        source: Whose estimates are disturbed.
        settings: ``bias_mm``, ``dropout`` and ``latency_s`` of it; what an episode draws is added.
        num_worlds: N of the simulation.
    """

    def __init__(self, source: Perceiver, settings: PerceptionSettings, num_worlds: int) -> None:
        self._source, self._plain = source, Disturbance.of(settings)
        self._worlds: list[_World | None] = [None] * num_worlds
        self._clock = LookClock(num_worlds)

    def begin(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Forget everything about some worlds."""
        self._source.begin(rows, seeds)
        self._clock.begin(rows)
        for row, seed in zip(rows, seeds, strict=True):
            rng = np.random.default_rng([PERCEPTION_STREAM, _OWN_STREAM, seed])
            self._worlds[row] = _World(rng=rng, disturbance=self._plain)

    def disturb(self, rows: np.ndarray, disturbances: Sequence[Disturbance]) -> None:
        """Give some worlds (n,), whose episodes have begun, what is wrong with their own eyes."""
        for row, disturbance in zip(rows, disturbances, strict=True):
            world = self._worlds[row]
            assert world is not None  # its episode has begun
            world.disturbance = disturbance
            if isinstance(self._source, ModelPerceiver):
                self._source.share[row] = disturbance.errors

    def observe(self, sim: Simulation, rows: np.ndarray) -> PoseEstimate:
        """Look through the other perceiver, and tell what is old, off or nothing new."""
        worlds, lost = [self._world(int(row)) for row in rows], []
        now, steps = self._source.observe(sim, rows), self._clock.steps(sim, rows)
        T_world_camera = sim.pose("head_camera")[rows]
        turns, shifts = np.zeros((*now.valid.shape, 3, 3)), np.zeros((*now.valid.shape, 3))
        for place, world in enumerate(worlds):
            if world.bias is None:
                world.bias = _draw_bias(world.rng, now.valid.shape[1], world.disturbance.bias_mm)
            turns[place], shifts[place] = world.bias
            lost.append(world.rng.random() < world.disturbance.dropout)
        T = now.T_camera_object
        biased = poses.from_rotation(turns @ T[..., :3, :3], T[..., :3, 3] + shifts)
        T_world_objects = T_world_camera[:, None] @ biased
        told = []
        for place, world in enumerate(worlds):
            world.now = round(world.now + float(steps[place]), 3)
            new = _Frame(
                at=world.now,
                T_world_objects=T_world_objects[place],
                valid=now.valid[place],
                age_s=now.age_s[place],
                inliers=now.inliers[place],
            )
            if lost[place] and world.seen:
                last = world.seen[-1]
                older_s = last.age_s + STEP_DT * float(steps[place])
                new = replace(last, at=world.now, valid=np.zeros_like(last.valid), age_s=older_s)
            frame = world.told(new)
            late_s = STEP_DT * round(world.now - frame.at, 3)
            told.append((frame.T_world_objects, frame.valid, frame.age_s + late_s, frame.inliers))
        T, valid, age, inliers = (np.stack(column) for column in zip(*told, strict=True))
        T_camera_objects = poses.invert(T_world_camera)[:, None] @ T
        return PoseEstimate(T_camera_object=T_camera_objects, valid=valid, age_s=age, inliers=inliers)

    def _world(self, row: int) -> _World:
        """Return what is remembered of a world, whose episode begins where it has not."""
        world = self._worlds[row]
        if world is None:
            self.begin(np.array([row]), [row])
            world = self._worlds[row]
            assert world is not None
        return world

    def faults(self, row: int) -> dict[str, int]:
        """Return what went wrong with the other perceiver in the episode of a world."""
        return faults_of(self._source, row)

    def close(self) -> None:
        """Close the other perceiver."""
        self._source.close()


def _draw_bias(rng: np.random.Generator, num_objects: int, length_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bias of an episode, of fixed lengths in random directions; see ``_World``."""
    axes = rng.standard_normal((2, num_objects, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return poses.rotation_from_vector(_TURN_OF_MM * length_mm * axes[0]), 1e-3 * length_mm * axes[1]
