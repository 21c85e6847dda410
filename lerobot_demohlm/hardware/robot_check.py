"""A robot on a network -> what it says of itself and what a deployment would refuse; nothing is sent to its motors.

Only ``rt/lowstate`` and ``rt/lowcmd`` are read, and the motion switcher is asked which controller runs.
"""

import time
from typing import Any

import numpy as np

from gym_demohlm.robot import g1
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.layout import MODE_MACHINE_29, LowState
from lerobot_demohlm.hardware.limits import Limits
from lerobot_demohlm.hardware.link import DOMAIN, LOW_CMD, LOW_STATE, Link
from lerobot_demohlm.hardware.motion_switcher import MotionSwitcher
from lerobot_demohlm.hardware.state_watch import GRAVITY, StateWatch

MIN_RATE_HZ = 400.0


def check_robot(interface: str, seconds: float = 3.0, domain: int = DOMAIN, *, ask: bool = True) -> dict[str, Any]:
    """Listen to a robot.

    Args:
        interface: Of the network.
        seconds: For how long [s].
        domain: Of DDS.
        ask: Whether to ask the motion switcher, the only thing that is sent.

    Returns:
        What was heard; "refused" lists what a deployment would not accept.

    Raises:
        RobotError: There is no such interface, or nobody speaks on it.
    """
    limits = Limits()
    link = Link(interface, domain)
    reader, commands = link.reader(LOW_STATE, newest=False), link.reader(LOW_CMD, newest=False)
    watch, arrived, heard, ticks = StateWatch(limits), [], 0, []
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for message in reader.take():
            if watch.take(message.content) and watch.state is not None:
                arrived.append(watch.time_ns)
                ticks.append(watch.state.tick)
        heard += len(commands.take())
        time.sleep(0.001)
    state = watch.state
    if state is None:
        refused = sum(watch.refused.values())
        raise RobotError(
            f"{refused} messages on {interface}, none of them sound", f"{LOW_STATE} of a G1",
            "check cable, address and that the robot is on; `ip addr` shows addresses",
        )  # fmt: skip
    span = 1e-9 * (arrived[-1] - arrived[0])
    gaps = 1e-6 * np.diff(arrived)
    robots = reader.writers()
    own = _own_controller(link) if ask else None
    found = {
        "interface": interface,
        "robots": robots,
        "state_hz": round((len(arrived) - 1) / span, 1) if span > 0 else 0.0,
        "largest_gap_ms": round(float(gaps.max()), 1) if len(gaps) else None,
        "refused_states": dict(watch.refused),
        "mode_machine": state.mode_machine,
        "mode_pr": state.mode_pr,
        "own_controller": own,
        "commands_heard": heard,
        "tilt_rad": round(watch.tilt, 3),
        "imu_error_rad": round(watch.imu_error, 3),
        "accelerometer_m_s2": round(float(np.linalg.norm(state.accelerometer)), 2),
        "hottest_celsius": watch.hottest()[0],
        "joints": {
            name: {"q": round(float(q), 4), "dq": round(float(dq), 3), "celsius": int(heat)}
            for name, q, dq, heat in zip(g1.BODY_JOINTS, state.q, state.dq, state.temperature.max(axis=1), strict=False)
        },
    }
    return found | {"refused": _refused(found, state, watch, limits)}


def _own_controller(link: Link) -> str | None:
    """Return the name of the robot's own controller; None where its motion switcher does not answer."""
    try:
        return MotionSwitcher(link, timeout_s=2.0).check()
    except RobotError:
        return None


def _refused(found: dict[str, Any], state: LowState, watch: StateWatch, limits: Limits) -> list[str]:
    """Return what a deployment would not accept, a line each."""
    lines = []
    if found["robots"] > 1:
        lines.append(f"{found['robots']} robots; switch the others off")
    if found["state_hz"] < MIN_RATE_HZ:
        lines.append(f"{found['state_hz']} states a second; expected 500: look for lost packets")
    if state.mode_machine != MODE_MACHINE_29:
        lines.append(f"mode_machine {state.mode_machine}; expected {MODE_MACHINE_29}, a G1 with 29 joints")
    if found["own_controller"] is None:
        lines.append("no answer of the motion switcher; it must be released by the remote")
    elif found["own_controller"]:
        lines.append(f"the robot's own controller {found['own_controller']!r}; hang the robot up and release it")
    if found["commands_heard"]:
        lines.append(f"{found['commands_heard']} commands of another controller; stop it")
    lines += [f"{g1.BODY_JOINTS[index]} outside its range; calibrate it" for index in np.flatnonzero(watch.outside())]
    if watch.tilt > 0.5 * limits.tilt:
        lines.append(f"pelvis leans {watch.tilt:.2f} rad; hang it upright")
    if watch.imu_error > limits.imu_error:
        lines.append(f"attitude and accelerometer differ by {watch.imu_error:.2f} rad; restart the robot")
    if abs(found["accelerometer_m_s2"] - GRAVITY) > 2.0:
        lines.append(f"an accelerometer that reads {found['accelerometer_m_s2']} m/s2 at rest")
    if found["hottest_celsius"] > limits.warm:
        lines.append(f"a motor of {found['hottest_celsius']:g} Celsius; let it cool")
    return lines
