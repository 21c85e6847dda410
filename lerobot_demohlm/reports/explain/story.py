"""The trace of an attempt -> what happened, in words and numbers: a timeline, frames, how commands were met."""

import math

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.timing import FPS, STEP_DT
from lerobot_demohlm.generation.hand_targets import Started
from lerobot_demohlm.generation.locomotion import LocomotionSettings
from lerobot_demohlm.reports.explain.trace import Trace

_ANCHORS = {
    "body": "the robot's body",
    "eef_heading": "the place of the hands, with the robot's heading",
    "eef": "the pose of the hands",
    "root": "the robot's root",
    "world": "the place of the hands, with the world's axes",
    "base": "the base as it walks",
}


def timeline(trace: Trace) -> list[tuple[float, str]]:
    """Return (time [s], sentence) of what happened, in order."""
    found: list[tuple[float, str]] = []
    if trace.placement is not None:
        goal, here = trace.placement.goal, poses.to_planar(trace.pelvis[0])
        turn = math.degrees(poses.wrap_angle(poses.yaw(trace.placement.symmetry)))
        seen = "as it lies" if abs(turn) < 0.5 else f"turned by {turn:.0f} deg, after which it looks the same"
        text = (
            f"the robot sets out from {planar_words(here)} for {planar_words(goal)}, "
            f"{math.dist(here[:2], goal[:2]):.2f} m away: where the demonstration stood, seen from the object {seen}"
        )
        found.append((0.0, text))
    for stage, start, _ in trace.bands()[1:]:
        step = round(start / STEP_DT)
        if stage == "pre_manipulation" and trace.placement is not None:
            missed = poses.to_planar(trace.pelvis[step]) - trace.placement.goal
            turn = abs(math.degrees(poses.wrap_angle(missed[2])))
            distance = math.hypot(missed[0], missed[1])
            text = f"it stands {distance:.3f} m and {turn:.0f} deg from its goal; pre-manipulation begins"
        else:
            text = f"{stage.replace('_', ' ')} begins"
        found.append((start, text))
    for begun, step in zip(trace.started, trace.started_at, strict=True):
        found.append((step * STEP_DT, begun_words(begun)))
    found += trace.touches()
    success = np.flatnonzero(trace.episode.success)
    if len(success):
        found.append((float(success[0] + 1) * STEP_DT, "the success condition holds for the first time"))
    ended = "success: the condition held throughout the last second"
    if trace.episode.outcome != "success":
        ended = f"{trace.episode.outcome.replace('_', ' ')}: {trace.episode.reason}"
    return [*sorted(found, key=lambda item: item[0]), (trace.duration_s, ended)]


def begun_words(begun: Started) -> str:
    """Return what began with a group of segments."""
    first, hands = begun.group[0], " and ".join(entry.hand for entry in begun.group)
    subject = f"the {hands} hand{'s' if len(begun.group) > 1 else ''}"
    verb = "" if len(begun.group) > 1 else "s"
    if first.kind == "object":
        return f"{subject} follow{verb} the {first.object}"
    held = f" with the {first.object}" if first.object is not None else ""
    return f"{subject} repeat{verb} the demonstrated motion{held}, relative to {_ANCHORS[first.anchor]}"


def frames_table(trace: Trace) -> list[dict[str, str]]:
    """Return a row for each group of segments: what followed what, from when, and between which frames."""
    rows = []
    for begun, step in zip(trace.started, trace.started_at, strict=True):
        first = begun.group[0]
        stop = max(entry.stop for entry in begun.group)
        rows.append(
            {
                "hands": " and ".join(entry.hand for entry in begun.group),
                "follows": str(first.object) if first.kind == "object" else f"itself ({first.anchor})",
                "source": f"{first.start / FPS:.1f} to {stop / FPS:.1f} s",
                "begins": f"{step * STEP_DT:.1f} s",
                "then": pose_words(begun.frames_then[0]),
                "now": pose_words(begun.frames_now[0]),
            }
        )
    return rows


def tracking_table(trace: Trace) -> list[tuple[str, str, dict[str, float]]]:
    """Return (quantity, unit, root mean square of measured less commanded by stage)."""
    commands, stages = trace.episode.commands, np.array(trace.stages)
    velocity = trace.base_velocity(LocomotionSettings().window_ticks) - commands[:, command.VELOCITY]
    torso = np.degrees(trace.torso_angles()[1:] - commands[:, [command.ROLL, command.PITCH, command.YAW]])
    height = trace.pelvis[1:, 2, 3] - commands[:, command.HEIGHT]
    errors = 1000 * trace.hand_errors()
    found = [
        ("forward velocity", "m/s", velocity[:, 0]),
        ("sideways velocity", "m/s", velocity[:, 1]),
        ("yaw rate", "rad/s", velocity[:, 2]),
        ("torso height", "mm", 1000 * height),
        ("torso roll", "deg", torso[:, 0]),
        ("torso pitch", "deg", torso[:, 1]),
        ("torso yaw", "deg", torso[:, 2]),
        ("left palm from its target", "mm", errors[:, 0]),
        ("right palm from its target", "mm", errors[:, 1]),
    ]
    return [
        (name, unit, {stage: _rms(values[stages == stage]) for stage in dict.fromkeys(trace.stages)})
        for name, unit, values in found
    ]


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def planar_words(planar: np.ndarray) -> str:
    """Return (x, y, yaw) in words."""
    return f"({planar[0]:.2f}, {planar[1]:.2f}) m, {math.degrees(planar[2]):.0f} deg"


def pose_words(T: np.ndarray) -> str:
    """Return a pose (4, 4) as position and heading."""
    x, y, z = T[:3, 3]
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m, {math.degrees(float(poses.yaw(T))):.0f} deg"
