"""The way to a simulated robot, measured: rates of the link; what further benchmarks of it share.

Robot and deployment are the processes of ``demohlm simulate-robot`` and ``demohlm deploy``, over loopback.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from lerobot_demohlm.hardware.deployment import Deployment
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.layout import LowCmd, LowState
from lerobot_demohlm.hardware.link import LOW_CMD, LOW_STATE, Link
from lerobot_demohlm.hardware.priority import Urgency, hurry
from lerobot_demohlm.hardware.records import Mode

START_S = 240.0  # that a robot may take to start
PATIENCE_S = 30.0
SETTLE_S = 1.0  # between the gantry's letting go and RUN
_LINK_HZ = 500
_OTHER = """
import json, sys, time
from lerobot_demohlm.benchmarks.deployment import answer_states
print(json.dumps(answer_states(int(sys.argv[1]), float(sys.argv[2]))), flush=True)
"""


class RobotProcess:
    """A ``demohlm simulate-robot`` and what it says.

    Args:
        task: Name of the task.
        domain: Of DDS.
        folder: For its servos and faults.
        options: Further options of the command.
        faults: What goes wrong.
    """

    def __init__(self, task: str, domain: int, folder: Path, options: Sequence[str] = (), faults: Any = None) -> None:  # noqa: ANN401
        self.servos = str(folder / "servos")
        command = [sys.executable, "-m", "lerobot_demohlm.cli", "simulate-robot", "--task", task, "--interface", "lo"]
        command += ["--domain", str(domain), "--servo-link", self.servos, *options]
        if faults is not None:
            path = folder / "faults.json"
            path.write_text(json.dumps(faults))
            command += ["--faults", str(path)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.events: list[dict[str, Any]] = []
        self._new: SimpleQueue[dict[str, Any]] = SimpleQueue()
        threading.Thread(target=self._hear, daemon=True).start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def wait_for(self, event: str, timeout_s: float) -> dict[str, Any]:
        """Return the next event of a kind.

        Raises:
            RobotError: None comes within the time.
        """
        until = time.monotonic() + timeout_s
        while (left := until - time.monotonic()) > 0.0:
            try:
                found = self._new.get(timeout=left)
            except Empty:
                break
            if found["event"] == event:
                return found
        last = self.events[-1] if self.events else "nothing"
        raise RobotError(f"no {event!r} of the simulated robot, but {last}", "one", "see what it printed")

    def end(self) -> dict[str, Any]:
        """End it; returns what it counted."""
        self._process.terminate()
        try:
            return self.wait_for("end", 20.0)
        except RobotError:
            return {}
        finally:
            self.kill()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()

    def _hear(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                event = json.loads(line)
            except ValueError:
                continue
            self.events.append(event)
            self._new.put(event)


@contextmanager
def robot_and_folder(
    task: str, domain: int, options: Sequence[str] = (), faults: Sequence[Mapping[str, Any]] | None = None
) -> Iterator[tuple[RobotProcess, Path]]:
    """Run a simulated robot, and yield it with a folder for records, once it hangs in its gantry."""
    with tempfile.TemporaryDirectory() as folder:
        robot = RobotProcess(task, domain, Path(folder), options, faults)
        try:
            robot.wait_for("hangs", START_S)
            yield robot, Path(folder)
        finally:
            robot.kill()


def measure_link(seconds: float, domain: int = 181) -> dict[str, Any]:
    """Send states at 500 Hz to another process that sends a command for each, for a while.

    Returns:
        Shares of messages late by more than 2 ms, both ways, and round trips.
    """
    other = subprocess.Popen(
        [sys.executable, "-c", _OTHER, str(domain), str(seconds + 1.0)], stdout=subprocess.PIPE, text=True
    )
    hurry(Urgency.CONTROL)
    link = Link("lo", domain)
    states, commands, state = link.writer(LOW_STATE), link.reader(LOW_CMD, newest=False), LowState()
    state.quat_wxyz[0] = 1.0
    until = time.monotonic() + START_S
    while commands.writers() == 0:
        if time.monotonic() > until:
            other.kill()
            raise RobotError("no other process", "one that answers", "try again")
        time.sleep(0.01)
    time.sleep(0.5)
    sent, trips, arrived, late = {}, [], [], 0
    began = time.monotonic()
    cpu = time.process_time()
    count = round(seconds * _LINK_HZ)
    for number in range(count):
        state.tick = number + 1
        state.seal()
        sent[number + 1] = now = time.monotonic()
        late += now > began + number / _LINK_HZ + 0.002
        states.send(state.to_bytes())
        for message in commands.take():
            got = LowCmd(message.content)
            if got.is_sound():
                arrived.append(time.monotonic())
                trips.append(1e3 * (arrived[-1] - sent.pop(int(got.q[0]), arrived[-1])))
        wait = began + (number + 1) / _LINK_HZ - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
    cpu = time.process_time() - cpu
    assert other.stdout is not None
    there = json.loads(other.stdout.readline())
    other.wait(10.0)
    gaps = 1e3 * np.diff(arrived)
    return {
        "part": "link",
        "seconds": seconds,
        "states_sent": count,
        "states_sent_late_share": late / count,
        "states_heard": there["states"],
        "states_gap_over_4_ms_share": there["late"] / max(there["states"], 1),
        "commands_heard": len(arrived),
        "commands_gap_over_4_ms_share": float((gaps > 4.0).mean()),
        "round_trip_p50_ms": float(np.percentile(trips, 50)),
        "round_trip_p99_ms": float(np.percentile(trips, 99)),
        "cores_used": cpu / seconds + there["cores"],
        **machine(),
    }


def answer_states(domain: int, seconds: float) -> dict[str, Any]:
    """Answer each state with a command that carries its tick, for a while after the first; returns what was heard."""
    hurry(Urgency.CONTROL)
    link = Link("lo", domain)
    reader, writer, command = link.reader(LOW_STATE, newest=False), link._writer(LOW_CMD), LowCmd()
    times: list[float] = []
    until, cpu = time.monotonic() + START_S, 0.0
    while time.monotonic() < until:
        for message in reader.take():
            state = LowState(message.content)
            if state.is_sound():
                if not times:
                    until, cpu = time.monotonic() + seconds, time.process_time()
                times.append(time.monotonic())
                command.q[0] = state.tick
                command.seal()
                writer.send(command.to_bytes())
        time.sleep(0.0005)
        if times and time.monotonic() - times[-1] > 0.5:
            break
    gaps = 1e3 * np.diff(times)
    return {"states": len(times), "late": int((gaps > 4.0).sum()), "cores": (time.process_time() - cpu) / seconds}


def settings_for(
    task: str, policy: Path, robot: RobotProcess, domain: int, root: Path | None, source: str = "exact"
) -> DeploymentSettings:
    """Return a deployment to a simulated robot."""
    return DeploymentSettings(
        task=task, interface="lo", policy=policy, pose_source=source, servo_port=robot.servos, root=root, domain=domain
    )


def stand_and_run(deployment: Deployment, robot: RobotProcess) -> float:
    """Have a hanging robot stand, wait until the gantry lets go, and run; returns when it ran (``time.monotonic``)."""
    until = time.monotonic() + PATIENCE_S
    while True:  # a machine at its limits may be late with one sign of life or another, and the robot brakes
        if deployment.mode != Mode.STAND:
            deployment.request(Mode.STAND)
        try:
            robot.wait_for("free", 0.5)
            break
        except RobotError as error:
            if time.monotonic() > until:
                remedy = "measure on a machine that is less busy"
                raise RobotError(deployment.reason or str(error), "a robot that stands", remedy) from error
    time.sleep(SETTLE_S)
    deployment.run(PATIENCE_S)
    return time.monotonic()


def machine() -> dict[str, Any]:
    """Return what a line says of the machine: its cores, and how busy they are."""
    return {"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2)}
