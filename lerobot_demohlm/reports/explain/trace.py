"""One attempt of a run -> the same attempt made again, with all that it aimed at and all that was measured, as arrays.

An attempt is a function of task, demonstration, region, seed and index, so a failed one that nobody kept can be looked
at as well as a success.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np

from gym_demohlm import poses
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import STEP_DT
from gym_demohlm.variation import Variation, get_variation
from lerobot_demohlm.datasets.episode import Episode
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.demonstrations.segmentation import contact_events
from lerobot_demohlm.generation.attempt import Attempt, Attempts
from lerobot_demohlm.generation.hand_targets import Started
from lerobot_demohlm.generation.retarget import Placement
from lerobot_demohlm.generation.stages import Settings
from lerobot_demohlm.reports.films import Take

_HAND_FRAMES = ("left_palm", "right_palm")


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """An attempt of T steps; rows 0..T are moments, rows 0..T-1 the steps between them. World frame.

    Attributes:
        task: The task.
        demonstration: Its source.
        variation: What may differ from world to world.
        episode: What a dataset would hold of it.
        placement: The symmetry chosen and the base goal; None where the attempt ended before.
        started: Segments that began, and between which frames they were carried over.
        started_at: Step at which each of them began.
        snapshots: T + 1, of a simulation with one world.
        pelvis: (T + 1, 4, 4).
        torso: (T + 1, 4, 4).
        hands: (T + 1, 2, 4, 4) palms.
        objects: (T + 1, k, 4, 4).
        supports: (4, 4) at the start, by name.
        targets: (T, 2, 4, 4) poses of the palms aimed at; NaN while walking to the object.
        ik_error: (T, 2) what inverse kinematics left of the way to them [m]; NaN likewise.
        ticks: (T,) of the demonstration; -1 likewise.
        stages: (T,) names.
        activities: (T,) what each command did, see ``Playback``; "walk" likewise.
        contact_forces: (5 T, pairs) at 50 Hz [N].
        collision_forces: (5 T,) [N].
        grippers: (T + 1, 2) travel of the jaws from open [m].
    """

    task: Task
    demonstration: Demonstration
    variation: Variation
    episode: Episode
    placement: Placement | None
    started: tuple[Started, ...]
    started_at: tuple[int, ...]
    snapshots: tuple[dict[str, np.ndarray], ...]
    pelvis: np.ndarray
    torso: np.ndarray
    hands: np.ndarray
    objects: np.ndarray
    supports: dict[str, np.ndarray]
    targets: np.ndarray
    ik_error: np.ndarray
    ticks: np.ndarray
    stages: tuple[str, ...]
    activities: tuple[str, ...]
    contact_forces: np.ndarray
    collision_forces: np.ndarray
    grippers: np.ndarray

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.episode.action)

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return len(self) * STEP_DT

    def take(self) -> Take:
        """Return the same to be drawn."""
        return Take(
            task=self.task,
            variation=self.variation,
            initial_state=self.episode.initial_state,
            snapshots=self.snapshots,
            origin="",
            outcome=self.episode.outcome,
            length_s=self.episode.length_s,
        )

    def bands(self) -> list[tuple[str, float, float]]:
        """Return (stage, start [s], stop [s]) in the order of time."""
        edges = [0, *(i for i in range(1, len(self)) if self.stages[i] != self.stages[i - 1]), len(self)]
        return [(self.stages[a], a * STEP_DT, b * STEP_DT) for a, b in itertools.pairwise(edges) if a < b]

    def base_velocity(self, window: int) -> np.ndarray:
        """Return the velocity of the base (T, 3) in its heading frame [m/s, m/s, rad/s].

        Args:
            window: Steps over which it is averaged, a period of the gait, whose sway is no velocity.
        """
        planar = poses.to_planar(self.pelvis)
        planar[:, 2] = np.unwrap(planar[:, 2])
        velocity = np.zeros((len(self), 3))
        for step in range(len(self)):
            first, last = max(0, step - window // 2), min(len(self), step + 1 + window // 2)
            moved = (planar[last] - planar[first]) / ((last - first) * STEP_DT)
            turn = poses.planar(0.0, 0.0, planar[step, 2])[:2, :2]
            velocity[step] = [*(turn.T @ moved[:2]), moved[2]]
        return velocity

    def torso_angles(self) -> np.ndarray:
        """Return roll, pitch against gravity and yaw against the pelvis (T + 1, 3) [rad], as commands mean them."""
        angles = poses.rpy(self.torso[:, :3, :3])
        yaw = poses.wrap_angle(poses.yaw(self.torso) - poses.yaw(self.pelvis))
        return np.stack([angles[:, 0], angles[:, 1], yaw], axis=1)

    def hand_errors(self) -> np.ndarray:
        """Return how far the palms are from what they were told a step ago (T, 2) [m]; NaN while walking."""
        return np.linalg.norm(self.targets[..., :3, 3] - self.hands[1:, :, :3, 3], axis=-1)

    def touches(self) -> list[tuple[float, str]]:
        """Return (time [s], words) of each touch and release."""
        mean = self.contact_forces.reshape(len(self), -1, self.contact_forces.shape[1]).mean(axis=1)
        found = contact_events(mean, self.task.contact_pairs, CONTACT_FORCE_N)
        words = {"touch": "touches", "release": "lets go of"}
        return [
            (event.tick * STEP_DT, f"the {event.hand} hand {words[event.kind]} the {event.object}") for event in found
        ]


@dataclass
class _Recorder:
    """Takes down one attempt as it goes."""

    running: Attempt | None = None
    snapshots: list[dict[str, np.ndarray]] = field(default_factory=list)
    frames: dict[str, list[np.ndarray]] = field(default_factory=dict)
    grippers: list[np.ndarray] = field(default_factory=list)
    targets: list[np.ndarray] = field(default_factory=list)
    errors: list[np.ndarray] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    activities: list[str] = field(default_factory=list)
    started_at: list[int] = field(default_factory=list)

    def on_step(self, sim: Simulation) -> None:
        """Take down what is measured."""
        self.snapshots.append(sim.snapshot())
        objects = (entry.name for entry in sim.task.objects)
        for name in dict.fromkeys(("pelvis", "torso", *_HAND_FRAMES, *objects, *sim.task.supports)):
            self.frames.setdefault(name, []).append(sim.pose(name)[0])
        self.grippers.append(sim.gripper_positions[0])

    def on_command(self, attempt: Attempt, _command: np.ndarray) -> None:
        """Take down what the command is for."""
        self.running, playback = attempt, attempt.playback
        self.targets.append(np.full((2, 4, 4), np.nan) if playback is None else playback.last_targets.copy())
        self.errors.append(np.full(2, np.nan) if playback is None else playback.error.copy())
        self.ticks.append(-1 if playback is None else playback.tick)
        self.activities.append("walk" if playback is None else playback.activity)
        if playback is None:
            self.started_at.clear()  # of a try before this one
        begun = 0 if playback is None else len(playback.started)
        self.started_at += [len(self.ticks) - 1] * (begun - len(self.started_at))


def trace(
    task: Task,
    demonstration: Demonstration,
    region: str,
    seed: int,
    index: int,
    settings: Settings | None = None,
    controller: str | None = None,
) -> Trace:
    """Make an attempt again and take everything down.

    Args:
        task: The task.
        demonstration: Of that task.
        region: Initial region.
        seed: Of the run.
        index: Of the attempt.
        settings: Of the run.
        controller: Name, path or hash of the run's whole-body controller; the default one by default.
    """
    recorder = _Recorder()
    attempts = Attempts(
        task,
        demonstration,
        region,
        seed,
        settings=settings,
        on_step=recorder.on_step,
        on_command=recorder.on_command,
        controller=controller,
    )
    (episode,) = attempts.run([index])
    attempts.close()
    running, steps = recorder.running, len(episode.action)
    started = () if running is None or running.playback is None else tuple(running.playback.started)
    forces = [] if running is None else running.contact_forces
    collisions = [] if running is None else running.collision_forces
    return Trace(
        task=attempts.task,
        demonstration=attempts.demonstration,
        variation=get_variation((settings or Settings()).variation.variation),
        episode=episode,
        placement=None if running is None else running.placement,
        started=started,
        started_at=(*recorder.started_at, *[steps] * (len(started) - len(recorder.started_at))),
        snapshots=tuple(recorder.snapshots),
        pelvis=np.stack(recorder.frames["pelvis"]),
        torso=np.stack(recorder.frames["torso"]),
        hands=np.stack([np.stack(recorder.frames[name]) for name in _HAND_FRAMES], axis=1),
        objects=np.stack([np.stack(recorder.frames[entry.name]) for entry in task.objects], axis=1),
        supports={name: recorder.frames[name][0] for name in task.supports},
        targets=_stacked(recorder.targets, (2, 4, 4)),
        ik_error=_stacked(recorder.errors, (2,)),
        ticks=np.array(recorder.ticks, dtype=int),
        stages=() if running is None else tuple(running.stages),
        activities=tuple(recorder.activities),
        contact_forces=_stacked(forces, (5, len(task.contact_pairs))).reshape(-1, len(task.contact_pairs)),
        collision_forces=_stacked(collisions, (5,)).reshape(-1),
        grippers=np.stack(recorder.grippers),
    )


def _stacked(rows: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.stack(rows) if rows else np.zeros((0, *shape))
