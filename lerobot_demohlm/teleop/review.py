"""A recording that has been stopped -> the demonstration in it, or why there is none.

What leads nowhere is cut off: the walk up to the object, the time before hands move, and what comes after success.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.task import InitialState, Task
from gym_demohlm.timing import HOLD_STEPS
from lerobot_demohlm.demonstrations.demonstration import CONTACT_FORCE_N, Demonstration
from lerobot_demohlm.demonstrations.segmentation import contact_events, gripper_events, segment
from lerobot_demohlm.demonstrations.segments import Event
from lerobot_demohlm.teleop.recorder import Recorder
from lerobot_demohlm.teleop.trial import Trial, TrialReport

LEAD_TICKS = 3  # kept before the first motion
SETTLED_TICKS = 10  # after walking up to an object, the recording begins once the robot has stood for so long
MOVED_M = 0.01  # motion of a palm's target that counts


@dataclass(kw_only=True)
class Review:
    """A recording that has been stopped.

    Attributes:
        demonstration: What would be saved; None where nothing can be.
        contacts: Touches found.
        held: Whether the task had succeeded for the last second.
        refusal: Why it cannot be saved; empty where it can.
        trial: The generated attempts that run; None before, after, and where none are made.
        report: How they stood at the last look.
    """

    demonstration: Demonstration | None
    contacts: int
    held: bool
    refusal: str
    trial: Trial | None = None
    report: TrialReport | None = None


def events(rows: list[dict[str, Any]], task: Task) -> list[Event]:
    """Return what the hands did in recorded rows, by time."""
    if not rows:
        return []
    found = contact_events(np.stack([row["contact_forces"] for row in rows]), task.contact_pairs)
    if task.hands == "gripper":
        found += gripper_events(np.stack([row["action"] for row in rows]))
    return sorted(found, key=lambda event: (event.tick, event.hand, event.kind))


def judge(recorder: Recorder, task: Task, operator: str, start: InitialState) -> Review:
    """Cut off what leads nowhere and say whether what remains can be saved.

    Args:
        recorder: With the recording.
        task: Its task.
        operator: Written into the demonstration.
        start: Where robot and objects were when the recording began.
    """
    rows = recorder.rows
    touches = [event for event in events(rows, task) if event.kind == "touch"]
    last = last_held(np.array([bool(row["success"]) for row in rows], dtype=bool))
    review = Review(demonstration=None, contacts=len(touches), held=last is not None, refusal="")
    if not touches:
        review.refusal = f"a recording in which no hand touches anything with {CONTACT_FORCE_N} N or more for 0.2 s"
    elif last is None:
        review.refusal = "a recording that does not hold success for 1 s"
    elif touches[0].tick >= last:
        review.refusal = "a recording whose success comes before any touch"
    else:
        first = first_row(rows, touches[0].tick)
        begin = start if first == 0 else start | {"robot": _stance(rows[first])}
        facts = {"cut": [first, len(rows) - last]}
        review.demonstration = recorder.demonstration(operator, begin, first=first, last=last, facts=facts)
        try:
            segment(review.demonstration, task)
        except DemonstrationError as error:
            review.refusal = str(error)
    return review


def _stance(row: dict[str, Any]) -> list[float]:
    """Return where the robot stood before a row: x, y, yaw [m, rad]."""
    position, quat_wxyz = np.split(row["pelvis_pose"], [3])
    return [float(position[0]), float(position[1]), float(2.0 * np.arctan2(quat_wxyz[3], quat_wxyz[0]))]


def last_held(success: np.ndarray) -> int | None:
    """Return the last row behind ten (1 s) that all succeeded, of (T,) bool; None where there are none."""
    if len(success) < HOLD_STEPS:
        return None
    sums = np.convolve(success.astype(np.int64), np.ones(HOLD_STEPS, dtype=np.int64), "valid")
    held = np.flatnonzero(sums == HOLD_STEPS)
    return int(held[-1]) + HOLD_STEPS if len(held) else None


def first_row(rows: list[dict[str, Any]], first_touch: int) -> int:
    """Return the row with which a demonstration begins: after a walk up to the object, and just before hands move.

    Args:
        rows: Of the recording.
        first_touch: Tick of the first touch.
    """
    velocity = np.array([row["action"][command.VELOCITY] for row in rows[:first_touch]]).reshape(-1, 3)
    walked = np.flatnonzero(np.abs(velocity).max(axis=1, initial=0.0) > 0.0)
    first = 0 if len(walked) == 0 else min(int(walked[-1]) + 1 + SETTLED_TICKS, first_touch)
    targets = np.stack([row["hand_targets"][:, :3] for row in rows[first : first_touch + 1]])
    moved = np.flatnonzero(np.linalg.norm(targets - targets[0], axis=2).max(axis=1) > MOVED_M)
    return first + max(0, int(moved[0]) - LEAD_TICKS) if len(moved) else first
