"""A seed -> one fault for a run, and the modes in which a robot must end for each."""

from collections import defaultdict

import numpy as np

from lerobot_demohlm.hardware.faults import PROCESSES, Fault
from lerobot_demohlm.hardware.records import Mode

_DAMP, _HOLD, _GOES_ON = (Mode.DAMP,), (Mode.HOLD,), (Mode.RUN,)
EXPECTED_MODES: defaultdict[tuple[str, str], tuple[Mode, ...]] = defaultdict(lambda: (Mode.RUN, Mode.HOLD, Mode.DAMP))
"""By kind and process. Loss in part, delays under the watchdog's limit, copies and exchanged messages are survived."""
for _process in PROCESSES:
    EXPECTED_MODES |= {
        ("loss", _process): _DAMP,
        ("delay", _process): _DAMP,
        ("bad_crc", _process): _DAMP,
        ("frozen_tick", _process): _DAMP,
        ("nan", _process): _DAMP,
        ("hot_motor", _process): _DAMP,
        ("mode_machine", _process): _DAMP,
        ("stuck_encoder", _process): (Mode.DAMP, Mode.HOLD),
        ("imu_drift", _process): _DAMP,
        ("remote_estop", _process): _DAMP,
        ("reorder", _process): _GOES_ON,
        ("duplicate", _process): _GOES_ON,
        ("pose_dropout", _process): _HOLD,
        ("full_disk", _process): _HOLD,
        ("kill", _process): _HOLD,
        ("stop", _process): _HOLD,
    }
_PLANS: tuple[tuple[str, float | None], ...] = (
    ("loss", 1.0), ("delay", 0.06), ("reorder", 0.3), ("duplicate", 0.5), ("bad_crc", 1.0), ("frozen_tick", None),
    ("nan", None), ("hot_motor", 100.0), ("mode_machine", None), ("stuck_encoder", None), ("imu_drift", 0.4),
    ("remote_estop", None), ("pose_dropout", None), ("kill", None), ("stop", None), ("full_disk", None),
)  # fmt: skip
_JOINTS = ("left_hip_pitch", "right_knee", "left_ankle_pitch", "waist_pitch")
FIRST_S, LAST_S = 1.5, 4.0  # when faults begin [s]


def draw_fault(seed: int, has_servos: bool = True) -> Fault:
    """Return the fault of a seed: kinds take turns, the rest is drawn.

    Args:
        seed: From 0.
        has_servos: Whether neck and grippers have a process of their own.
    """
    rng = np.random.default_rng([29, seed])
    kind, size = _PLANS[seed % len(_PLANS)]
    processes = [name for name in PROCESSES if name != "servos" or has_servos]
    if kind in ("kill", "stop"):
        process = processes[(seed // len(_PLANS)) % len(processes)]
    else:
        process = "recorder" if kind == "full_disk" else "policy"
    return Fault(
        kind=kind,
        at_s=float(np.round(rng.uniform(FIRST_S, LAST_S), 3)),
        size=size,
        joint=str(rng.choice(_JOINTS)),
        process=process,
    )
