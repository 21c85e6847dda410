"""Actions of a LeRobot loop -> a simulated world that runs against the clock, and what is seen of it.

LeRobot hands a teleoperator no more than the robot's joints, and a loop may run at any rate. So the world steps in a
thread of its own, and a teleoperator of the same process sees it here, as a person sees the room.
"""

import math
import threading
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.realtime import RealTimeWorld
from lerobot_demohlm.teleop.recorder import scene_view, take_over
from lerobot_demohlm.teleop.web.record import operators_place

SILENCE_S = 0.3  # without an action for so long, the robot stands


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The world at one moment.

    Attributes:
        episode: Number of the start.
        step: Steps of 0.1 s since that start.
        view: What an operator sees.
        state: (68,) float32, ``observation.STATE_NAMES``.
        environment_state: (9k,) float32, the tracked objects.
        joint_positions: (29,) of the body joints [rad].
        success: Whether the task's condition holds.
    """

    episode: int
    step: int
    view: SceneView
    state: np.ndarray
    environment_state: np.ndarray
    joint_positions: np.ndarray
    success: bool


class Operated(Protocol):
    """What a teleoperator sees: a simulated world, or the mirror of a robot at the other end of a network."""

    task: Task
    sim: Simulation
    pace: RealTimeWorld
    seen: Seen
    framed_s: float
    """When a dataset of LeRobot's got its newest frame of the present episode, by ``time.monotonic`` [s]; ``-inf``
    where it holds none that it has not stored."""
    stays: bool
    """Whether a new episode leaves the robot as it is, as it does a real one."""

    def reset(self) -> Seen:
        """Begin the next episode."""
        ...


class LiveWorld:
    """One world, stepped by a thread at 10 Hz, or by ``send`` itself.

    Args:
        task: The task.
        region: From which each episode's objects are drawn.
        seed: Of these draws.
        spread: Share of the region's offsets.
        by_clock: Whether a thread steps it.

    Attributes:
        task: The task.
        sim: The world; only its own thread may step it.
        pace: What holds it to the clock.
        seen: The world after the last step.
        framed_s: See ``Operated``.
        stays: See ``Operated``.
    """

    stays = False

    def __init__(self, task: Task, region: str, seed: int, spread: float, *, by_clock: bool) -> None:
        self.task, self.sim = task, Simulation(task)
        self.pace = RealTimeWorld(self.sim)
        self.framed_s = -math.inf
        self._region, self._seed, self._spread, self._by_clock = region, seed, spread, by_clock
        self._lock = threading.RLock()
        self._wanted, self._sent_at = command.rest(), -np.inf
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="world", daemon=True)
        self._episode, self._step = -1, 0
        self.reset()
        if by_clock:
            self._thread.start()

    def reset(self) -> Seen:
        """Begin the next episode at a new start; returns what is seen there."""
        with self._lock:
            self._episode += 1
            self._step = 0
            self.pace.start()
            start = operators_place(self.task, self._seed + self._episode, self._region, self._spread)
            take_over(self.sim, start)
            self.pace.start()
            self._wanted, self._sent_at = command.rest(), -np.inf
            self.seen = self._look()
            return self.seen

    def send(self, wanted: np.ndarray) -> None:
        """Take in an action (23,): the newest counts when the next step begins; without a thread it is that step."""
        if not self._by_clock:
            with self._lock:
                self._advance(wanted)
            return
        self._wanted, self._sent_at = wanted.copy(), time.monotonic()

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self.sim.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.pace.wait()
            with self._lock:
                wanted = self._wanted.copy()
                if time.monotonic() - self._sent_at > SILENCE_S:
                    wanted[command.VELOCITY] = 0.0
                self._advance(wanted)

    def _advance(self, wanted: np.ndarray) -> None:
        self.sim.step(wanted.astype(np.float32).astype(np.float64)[None])
        self._step += 1
        self.seen = self._look()

    def _look(self) -> Seen:
        sim = self.sim
        return Seen(
            episode=self._episode,
            step=self._step,
            view=scene_view(sim, self._step),
            state=observation.agent_pos(sim)[0],
            environment_state=observation.environment_state(sim)[0],
            joint_positions=sim.joint_positions[0],
            success=bool(sim.success()[0]),
        )


_current: Operated | None = None


def current() -> Operated | None:
    """Return the world of the robot that this process has connected; None where there is none."""
    return _current


def set_current(world: Operated | None) -> None:
    """Make a world the one that teleoperators of this process see."""
    global _current
    _current = world
