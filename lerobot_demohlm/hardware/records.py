"""What each process of a deployment tells the others: one record a process, each in a slot of its own."""

from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm.control import command
from lerobot_demohlm.hardware.layout import NUM_JOINTS
from lerobot_demohlm.hardware.slots import Slot

MAX_OBJECTS = 4
REASON_SIZE = 160  # bytes


class Mode(IntEnum):
    """What the robot does.

    DAMP: motors brake and do not hold. STAND: a ramp to the home pose, then balance at rest. RUN: it follows the
    policy. HOLD: it balances where it is, velocity 0, arms as they were.
    """

    DAMP = 0
    STAND = 1
    RUN = 2
    HOLD = 3


_JOINTS = (NUM_JOINTS,)
RECORDS: dict[str, np.dtype] = {
    # Of the control process: what the robot said last.
    "state": np.dtype([
        ("tick", "<u4"), ("q", "<f8", _JOINTS), ("dq", "<f8", _JOINTS), ("tau", "<f8", _JOINTS),
        ("quat_wxyz", "<f8", 4), ("gyro", "<f8", 3), ("accelerometer", "<f8", 3),
        ("temperature", "<i2", _JOINTS), ("mode_machine", "u1"), ("buttons", "<u2"),
        ("T_odometry_pelvis", "<f8", (4, 4)), ("T_odometry_torso", "<f8", (4, 4)),
    ]),
    # Of the control process: what it does, why, and what it sent; ages in s when it decided.
    "control": np.dtype([
        ("mode", "u1"), ("reason", f"S{REASON_SIZE}"), ("since_ns", "<i8"), ("standing", "?"), ("latched", "?"),
        ("command", "<f8", command.SIZE), ("wanted_q", "<f8", _JOINTS), ("sent_q", "<f8", _JOINTS),
        ("kp", "<f8", _JOINTS), ("kd", "<f8", _JOINTS), ("state_age_s", "<f8"), ("policy_age_s", "<f8"),
        ("pose_age_s", "<f8"), ("servos_age_s", "<f8"), ("operator_age_s", "<f8"), ("recorder_age_s", "<f8"),
        ("tilt", "<f8"), ("changed", "<u4"), ("refused_states", "<u4"), ("ticks", "<u8"), ("late_ticks", "<u4"),
        ("compute_s", "<f8"),
    ]),
    # Of the policy: its newest command, for which run (when it was entered), and when what it saw was measured.
    "policy": np.dtype([
        ("command", "<f8", command.SIZE), ("episode", "<u4"), ("step", "<u4"), ("run_ns", "<i8"),
        ("state_ns", "<i8"), ("pose_ns", "<i8"),
        ("inference_s", "<f8"), ("observed_state", "<f4", 68), ("observed_objects", "<f4", 9 * MAX_OBJECTS),
    ]),
    # Of the pose source: objects in the frame head_camera, and where that was when it looked.
    "pose": np.dtype([
        ("T_camera_object", "<f8", (MAX_OBJECTS, 4, 4)), ("valid", "?", MAX_OBJECTS), ("age_s", "<f8", MAX_OBJECTS),
        ("looking_s", "<f8"), ("T_odometry_camera", "<f8", (4, 4)),
    ]),
    # Of the one who operates: what is asked for; an e-stop stays one.
    "operator": np.dtype([("mode", "u1"), ("number", "<u4"), ("estop", "?"), ("source", "S32")]),
    # Of the control process, for neck [rad] and grippers [0 open .. 1 closed].
    "servo_goals": np.dtype([("neck", "<f8", 2), ("grippers", "<f8", 2), ("enabled", "?")]),
    # Of the servos' process: positions [rad], [m] and their velocities; why one does not hold, empty while all do.
    "servos": np.dtype([
        ("neck", "<f8", 2), ("neck_dq", "<f8", 2), ("jaws", "<f8", 2), ("jaws_dq", "<f8", 2), ("temperature", "<i2", 4),
        ("errors", "<u4"), ("reason", f"S{REASON_SIZE}"),
    ]),
    # Of the recorder.
    "recorder": np.dtype([("rows", "<u8"), ("bytes", "<u8"), ("failed", "?"), ("reason", f"S{REASON_SIZE}")]),
}  # fmt: skip


def slot(folder: Path, name: str) -> Slot:
    """Return the slot of a record in a folder that all processes of a deployment share."""
    return Slot(folder / f"{name}.slot", RECORDS[name])


def record(name: str, **values: Any) -> np.void:  # noqa: ANN401
    """Return a record with some fields set; the others are zero."""
    made = np.zeros((), RECORDS[name])
    for field, value in values.items():
        made[field] = value
    return made[()]  # pyright: ignore[reportReturnType]


def text(value: Any) -> str:  # noqa: ANN401
    """Return the text of a field."""
    return bytes(value).decode(errors="replace")
