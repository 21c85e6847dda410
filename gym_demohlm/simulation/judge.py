"""Worlds, step by step -> who has succeeded, fallen, collided or lost an object: one judge for attempts and rollouts.

Generation ends an attempt at the first fault; an episode of the environment goes on after a collision or a drop, and
its outcome is judged where it ends. The rules are the same:

- success: the task's condition has held for the last second.
- fell: the pelvis is low or tilted, or the physics broke down.
- collided: the robot has pressed on an obstacle in three steps in a row (0.3 s), at some time in each with more than
  60 N.
- dropped, or another of the task's failures: its predicate holds.

The strict success asks for more: it is held, nothing was dropped and nothing was collided with at any time, and the
robot, told to keep its posture and to stand, does so for two more seconds without a fault. Nothing that success rests
on may fall meanwhile, not even to where it stood at first. These seconds are no part of the episode: the worlds are
brought back to where it ended.

Rollouts measured before this judge counted any touch of an obstacle above 1 N as "collided". So among their episodes
without success more were "collided", and fewer were "timeout". One that had both collided and dropped an object was
"dropped", and is "collided" now. Successes and falls are counted as before.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.timing import HOLD_STEPS, STAND_STEPS, STEP_DT

if TYPE_CHECKING:
    from gym_demohlm.simulation.simulation import Simulation, StepResult

OUTCOMES = ("success", "ik_failed", "fell", "dropped", "collided", "timeout", "off_course")
"""How an attempt or a rollout may end. "ik_failed" and "off_course" are an attempt's alone."""

FALLEN_HEIGHT = 0.33  # m, of the pelvis; the lowest command is 0.40 m
FALLEN_TILT = math.radians(60.0)  # of the pelvis against the vertical
COLLISION_N = 60.0  # force between robot and obstacle that counts as a collision
COLLISION_S = 0.3  # once it has lasted this long
COLLISION_STEPS = round(COLLISION_S / STEP_DT)
FALL_M = 0.03  # m that an object is lower after the two seconds; with the condition gone, it was dropped
_AHEAD = (1.0, 0.0, 0.0)  # m, in the frame "head_camera"


class Judge:
    """Watches the worlds of a simulation from their resets on.

    Args:
        sim: The simulation.

    Attributes:
        condition: (N,) bool, whether the task's success condition holds now.
        success: (N,) bool, whether it holds and the physics is sound.
        success_ever: (N,) bool, whether ``success`` was true at the reset or after any step.
        fell: (N,) bool, whether the robot lies now.
        unstable: (N,) bool, whether the physics broke down since the reset.
        collided: (N,) bool, whether the robot has collided since the reset.
        failures: The task's failure predicates by name, (N,) bool each, as they are now.
        faulty: (N,) bool, whether anything has gone wrong since the reset, also where it has been mended since.
    """

    def __init__(self, sim: "Simulation") -> None:
        self._sim = sim
        count = sim.num_worlds
        self._held_steps = np.zeros(count, dtype=np.int64)
        self._pressed_steps = np.zeros(count, dtype=np.int64)
        self.success_ever = np.zeros(count, dtype=bool)
        self.collided = np.zeros(count, dtype=bool)
        self.faulty = np.zeros(count, dtype=bool)
        self._look()

    def reset(self, worlds: np.ndarray) -> None:
        """Forget what has happened in some worlds, just after their reset.

        Args:
            worlds: (n,) indices.
        """
        self._look()
        self._held_steps[worlds] = self._pressed_steps[worlds] = 0
        self.collided[worlds] = self.faulty[worlds] = False
        self.success_ever[worlds] = self.success[worlds]

    def watch(self, result: "StepResult", moved: np.ndarray) -> None:
        """Judge a step.

        Args:
            result: What ``Simulation.step`` returned.
            moved: (N,) bool, the worlds that were stepped; what has happened in the others stays as it was.
        """
        self._look()
        self.success_ever |= moved & self.success
        self._held_steps = np.where(moved, np.where(self.success, self._held_steps + 1, 0), self._held_steps)
        pressed = result.collision_forces.max(axis=1) > COLLISION_N
        self._pressed_steps = np.where(moved, np.where(pressed, self._pressed_steps + 1, 0), self._pressed_steps)
        self.collided |= self._pressed_steps >= COLLISION_STEPS
        self.faulty |= moved & np.any(list(self.faults().values()), axis=0)

    @property
    def success_held(self) -> np.ndarray:
        """(N,) bool, whether success has lasted for a second without a break."""
        return self._held_steps >= HOLD_STEPS

    def faults(self) -> dict[str, np.ndarray]:
        """Return what has gone wrong, (N,) bool by name, the worst first: fell, collided, the task's failures."""
        faults = {"fell": self.fell | self.unstable, "collided": self.collided.copy()}
        for name, holds in self.failures.items():
            faults[name] = holds | faults[name] if name in faults else holds.copy()
        return faults

    def strict(self, worlds: np.ndarray) -> np.ndarray:
        """Return which of some worlds, whose episodes end now, are strict successes; every world stays as it is.

        Args:
            worlds: (n,) indices.

        Returns:
            (n,) bool.
        """
        good = self.success_held[worlds] & ~self.faulty[worlds]
        if not good.any():
            return good
        good[good] = _stands(self._sim, worlds[good])
        return good

    def _look(self) -> None:
        sim = self._sim
        self.unstable, self.fell, self.failures = sim.unstable, sim.fallen(), sim.failures()
        self.condition = sim.success()
        self.success = self.condition & ~self.unstable


def _stands(sim: "Simulation", worlds: np.ndarray) -> np.ndarray:
    """Return which of some worlds (n,) have no fault while the robot stands and keeps its posture for two seconds.

    An object that is ``FALL_M`` lower at their end was dropped, if the success condition no longer holds: a box that
    slips a little in the hands is lifted still, and a cube that no hand presses on for a moment has not fallen.
    """
    before, on_tick, gaze = sim.snapshot(), sim.on_tick, sim.p_camera_gaze
    active = np.zeros(sim.num_worlds, dtype=bool)
    active[worlds], sim.on_tick = True, None
    if gaze is not None:  # told in the camera's frame, and nobody looks meanwhile: the neck stays
        sim.p_camera_gaze = np.broadcast_to(_AHEAD, gaze.shape)
    commands = sim.command
    commands[:, command.VELOCITY] = 0.0
    after, heights = Judge(sim), _heights(sim)
    for _ in range(STAND_STEPS):
        after.watch(sim.step(commands, active), active)
    dropped = ~after.condition & np.any(_heights(sim) < heights - FALL_M, axis=1)
    sim.restore(before)
    sim.on_tick, sim.p_camera_gaze = on_tick, gaze
    return ~(after.faulty | dropped)[worlds]


def _heights(sim: "Simulation") -> np.ndarray:
    """Return how high the objects are (N, number of objects) [m]."""
    return np.stack([sim.pose(entry.name)[:, 2, 3] for entry in sim.task.objects], axis=1)


def held(success: Sequence[bool] | np.ndarray) -> bool:
    """Return whether a success condition, by step, has held for the last second: then the attempt is a success."""
    last = success[-HOLD_STEPS:]
    return len(last) == HOLD_STEPS and bool(np.all(last))


def fault_outcome(name: str) -> str:
    """Return the outcome that a fault stands for; a task's failure that is no outcome counts as "dropped"."""
    return name if name in OUTCOMES else "dropped"


def outcome(success_held: bool, faults: Mapping[str, bool]) -> str:
    """Return how an episode ended.

    Args:
        success_held: Whether success was held at its end.
        faults: What had gone wrong by then, by name, the worst first (``Judge.faults``).
    """
    if success_held:
        return "success"
    return next((fault_outcome(name) for name, happened in faults.items() if happened), "timeout")
