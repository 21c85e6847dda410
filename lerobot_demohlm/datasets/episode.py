"""One attempt at a task as arrays, and what of it ``meta/episodes`` holds; without torch or lerobot."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.envs import observation
from gym_demohlm.errors import DatasetError
from gym_demohlm.simulation.judge import OUTCOMES
from gym_demohlm.timing import FPS, STEP_DT
from gym_demohlm.variation import Conditions
from lerobot_demohlm.reproducibility.fingerprint import FIELDS


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One attempt at a task at 10 Hz, successful or not."""

    task: str
    """Name of the task, without version: ``LiftBox``."""
    task_text: str
    """The task in words, as a language-conditioned policy reads it."""
    index: int
    """Index of the attempt in its run, from 0."""
    seed: int
    """Seed of the run (the attempt is a function of seed and index)."""
    region: str
    """Initial region, R1 to R4."""
    outcome: str
    """One of ``OUTCOMES``."""
    stage: str
    """Stage in which the attempt ended: the last one, where it succeeded."""
    state: np.ndarray
    """(T, 68) float32, ``observation.STATE_NAMES``, before each action."""
    environment_state: np.ndarray
    """(T, 9k) float32, tracked objects in the camera frame, before each action."""
    action: np.ndarray
    """(T, 23) float32, ``command.NAMES``: what was planned, and executed where ``executed`` says no other."""
    success: np.ndarray
    """(T,) bool, whether the task's condition held after each action."""
    initial_state: dict[str, list[float]]
    """What the reset drew, by name: robot and object poses [m, rad]."""
    length_s: float
    """Simulated time until the attempt ended [s]."""
    reason: str = ""
    """What ended it, in words; empty for a success."""
    stage_ticks: dict[str, int] = field(default_factory=dict)
    """Frames by stage, in the order of time."""
    fingerprints: np.ndarray = field(default_factory=lambda: np.zeros((0, len(FIELDS)), dtype="<u4"))
    """(T + 1, 4) uint32, of the whole simulation at the start and after each action; (0, 4) where unknown."""
    digest: str = ""
    """SHA-256 of the same, in hexadecimal."""
    retries: int = 0
    """How often it began again after a stage that failed."""
    success_strict: bool = False
    """Whether it succeeded without a fault at any time, and the robot stood for 2 s after it."""
    executed: np.ndarray | None = None
    """(T, 23) float32, the actions with the noise that they carried when they were executed; None without noise."""

    @property
    def commands(self) -> np.ndarray:
        """(T, 23) float32, what was executed."""
        return self.action if self.executed is None else self.executed

    def __post_init__(self) -> None:
        """Check shapes, types and values, so that nothing invalid travels."""
        if self.outcome not in OUTCOMES:
            raise DatasetError(f"outcome {self.outcome!r}", f"one of {', '.join(OUTCOMES)}", "name a known outcome")
        width = self.environment_state.shape[-1] if self.environment_state.ndim == 2 else -1
        expected = {
            "state": (len(self.success), len(observation.STATE_NAMES)),
            "environment_state": (len(self.success), width),
            "action": (len(self.success), command.SIZE),
            "commands": (len(self.success), command.SIZE),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise DatasetError(
                    f"{name} {array.dtype} {array.shape}", f"float32 {shape}", "give one row a step of success"
                )
            if not np.isfinite(array).all():
                raise DatasetError(f"NaN or infinity in {name}", "finite numbers", "discard this attempt")
        if self.success.dtype != np.bool_ or self.success.ndim != 1:
            raise DatasetError(f"success {self.success.dtype} {self.success.shape}", "bool (T,)", "convert it")
        if len(self.fingerprints) not in (0, len(self.success) + 1):
            raise DatasetError(
                f"{len(self.fingerprints)} fingerprints", f"{len(self.success) + 1}", "give one a state, or none"
            )
        if self.outcome == "success" and len(self.success) == 0:
            raise DatasetError("a successful episode without frames", "one frame or more", "record its steps")

    def record(self) -> dict[str, Any]:
        """Return the attempt's line of ``meta/demohlm_attempts.jsonl``, without arrays."""
        return {
            "attempt": self.index,
            "outcome": self.outcome,
            "stage": self.stage,
            "reason": self.reason,
            "length_s": round(float(self.length_s), 3),
            "stage_s": {stage: round(ticks * STEP_DT, 3) for stage, ticks in self.stage_ticks.items()},
            "frames": len(self.success),
            "initial_state": {name: [float(v) for v in values] for name, values in self.initial_state.items()},
            "digest": self.digest,
            "retries": self.retries,
            "success_strict": self.success_strict,
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any], **rest: Any) -> "Episode":  # noqa: ANN401
        """Return the attempt whose line ``record`` gave.

        Args:
            record: The line.
            rest: What no line has: task, seed and region of the run, and arrays.
        """
        return cls(
            index=record["attempt"],
            outcome=record["outcome"],
            stage=record["stage"],
            reason=record["reason"],
            length_s=record["length_s"],
            stage_ticks={stage: round(seconds * FPS) for stage, seconds in record["stage_s"].items()},
            initial_state=record["initial_state"],
            digest=record["digest"],
            retries=record.get("retries", 0),
            success_strict=record.get("success_strict", False),
            **rest,
        )

    def labels(self) -> dict[str, Any]:
        """Return what the episode's row of ``meta/episodes`` says beside what LeRobot writes there."""
        executed = {} if self.executed is None else {"executed": self.executed.tobytes()}
        conditions = Conditions.read(self.initial_state).write()
        return {
            "attempt": self.index,
            "outcome": self.outcome,
            "stage": self.stage,
            "fingerprints": self.fingerprints.tobytes(),
            **executed,
            **({"conditions": json.dumps(conditions)} if conditions else {}),
        }


def executed_of(labels: Mapping[str, Any], frames: int) -> np.ndarray | None:
    """Return the executed commands (T, 23) that ``Episode.labels`` wrote; None where they are the actions.

    Raises:
        DatasetError: They are not one a frame.
    """
    content = labels.get("executed")
    if content is None:
        return None
    if not isinstance(content, bytes) or len(content) != 4 * command.SIZE * frames:
        got, expected = "executed commands of another length than the episode", f"{frames} times {command.SIZE} float32"
        raise DatasetError(got, expected, "restore the dataset, or generate it again")
    return np.frombuffer(content, dtype="<f4").reshape(frames, command.SIZE)
