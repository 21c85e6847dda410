"""Seeded faults -> how a simulated robot and its deployment answer to each, over DDS and loopback."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gym_demohlm.registry import get_task
from lerobot_demohlm.benchmarks.deployment import (
    PATIENCE_S,
    RobotProcess,
    machine,
    robot_and_folder,
    settings_for,
    stand_and_run,
)
from lerobot_demohlm.evaluation.loaded_policy import policy_hash
from lerobot_demohlm.hardware import recorder
from lerobot_demohlm.hardware.deployment import Deployment
from lerobot_demohlm.hardware.fault_plan import EXPECTED_MODES, draw_fault
from lerobot_demohlm.hardware.faults import PROCESS_FAULTS, Fault
from lerobot_demohlm.hardware.records import Mode


def measured_seeds(lines: Iterable[Mapping[str, Any]], task: str, policy: Path) -> set[int]:
    """Return the seeds of the faults that lines of ``measure_faults`` have for a task and a policy."""
    wanted = {"part": "faults", "task": get_task(task).name, "policy": policy_hash(policy)[:12]}
    return {line["seed"] for line in lines if wanted.items() <= line.items()}


def measure_faults(task: str, policy: Path, seeds: Sequence[int], domain: int = 183) -> Iterator[dict[str, Any]]:
    """Let one seeded fault happen in a run each; yields how the robot answered.

    One simulated robot has all the runs. A deployment goes on from run to run until one of its own processes is what
    fails; its runs are yielded when it has ended, as only then its record is whole.

    Args:
        task: Name of the task.
        policy: A ``pretrained_model`` directory.
        seeds: Of the faults; start i of the robot has the i-th of them.
        domain: Of DDS.
    """
    has_servos = get_task(task).hands == "gripper"
    left = [(seed, draw_fault(seed, has_servos)) for seed in seeds]
    if not left:
        return
    files = [{"seed": seed, "faults": [vars(fault)] if _is_robots(fault) else []} for seed, fault in left]
    options = ["--region", "R1", "--seed", str(left[0][0])]
    with robot_and_folder(task, domain, options, files) as (robot, folder):
        while left:
            last = next((index for index, (_, fault) in enumerate(left) if not _is_robots(fault)), len(left) - 1)
            batch, left = left[: last + 1], left[last + 1 :]
            root = folder / f"record_{batch[0][0]}"
            with Deployment(settings_for(task, policy, robot, domain, root)) as deployment:
                answers = [fault_run(deployment, robot, seed, fault) for seed, fault in batch]
            if "executed" not in answers[-1]:
                answers[-1] |= _counted(robot)
            known = _recorded(root)
            for answer in answers:
                moment = answer.pop("since_ns"), answer["reason"]
                on_record = None if answer["process"] == "recorder" else moment in known
                of = {"part": "faults", "task": get_task(task).name, "policy": policy_hash(policy)[:12]}
                yield {**of, **answer, "reason_recorded": on_record, **machine()}


def _recorded(root: Path) -> set[tuple[int, str]]:
    """Return when each mode of a record began [ns], with its reason."""
    if not list(root.glob("*.parquet")):
        return set()
    rows = recorder.read(root)
    return set(zip(rows["control.since_ns"].to_pylist(), rows["control.reason"].to_pylist(), strict=True))


def _is_robots(fault: Fault) -> bool:
    """Return whether the robot has it, not a process of the deployment."""
    return fault.kind not in PROCESS_FAULTS


def fault_run(deployment: Deployment, robot: RobotProcess, seed: int, fault: Fault) -> dict[str, Any]:
    """Run a policy, let something go wrong, and look whether the robot ends as it must.

    Args:
        deployment: To the robot, which hangs in its gantry.
        robot: It has the fault in this start, where the fault is the robot's.
        seed: Of the fault.
        fault: What goes wrong.

    Returns:
        The answer, with ``since_ns``, when its mode began. The robot hangs again, and what it counted is in the answer,
        unless the fault is one of the deployment's processes: then that ends first.
    """
    process = None if _is_robots(fault) else fault.process
    began = stand_and_run(deployment, robot)
    free = next(event for event in reversed(robot.events) if event["event"] == "free")["time_s"]
    at = (began if process else free) + fault.at_s
    time.sleep(max(0.0, at - time.monotonic()))
    if process:
        at = time.monotonic()
        deployment.apply(fault)
    expected = EXPECTED_MODES[fault.kind, fault.process]
    mode, answered_ns = _wait_for_answer(deployment, 6.0)
    reason, since_ns, damped = deployment.reason, deployment.since_ns, None
    if fault.kind in ("kill", "stop") and process == "control":
        damped = robot.wait_for("damped", 3.0)
    time.sleep(0.3)
    answer = {
        "seed": seed,
        "fault": fault.kind,
        "process": process,
        "mode": mode.name,
        "answer_ms": None if answered_ns is None else 1e-6 * answered_ns - 1e3 * at,
        "damped_after_ms": None if damped is None else damped["silence_ms"],
        "reason": reason,
        "since_ns": since_ns,
        "as_specified": mode in expected or damped is not None,
    }
    if process:
        return answer
    deployment.request(Mode.DAMP)
    return answer | _counted(robot)


def _counted(robot: RobotProcess) -> dict[str, Any]:
    """Wait until the robot hangs again; returns what it counted since it hung before."""
    robot.wait_for("hangs", PATIENCE_S)
    before, after = [event for event in robot.events if event["event"] == "hangs"][-2:]
    return {
        "violations": after["violations"] - before["violations"],
        "worst": after["worst"],
        "executed": after["executed"] - before["executed"],
        "refused_crc": after["bad_crc"] - before["bad_crc"],
    }


def _wait_for_answer(deployment: Deployment, timeout_s: float) -> tuple[Mode, int | None]:
    """Return the mode that a fault led to, and when it was entered [ns, ``time.monotonic_ns``]; None where to none."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        reading = deployment.read("control")
        if reading is not None and Mode(int(reading.value["mode"])) != Mode.RUN:
            return Mode(int(reading.value["mode"])), int(reading.value["since_ns"])
        time.sleep(0.002)
    return deployment.mode, None
