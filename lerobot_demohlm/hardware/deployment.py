"""A policy, a pose source, a controller, servos and a recorder -> processes that drive one robot, and who watches them.

They are started in an order in which everything that can be refused is refused before the first command is sent:
policy, poses, servos and recorder must be ready before the controller starts, and it only brakes until it is asked to
stand.
"""

import atexit
import hashlib
import json
import math
import multiprocessing
import os
import resource
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self

import numpy as np

from gym_demohlm.control import controllers
from gym_demohlm.files import replace_text
from gym_demohlm.registry import get_task
from lerobot_demohlm.evaluation.loaded_policy import policy_hash
from lerobot_demohlm.hardware import records
from lerobot_demohlm.hardware.deployment_settings import DeploymentSettings
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.faults import Fault
from lerobot_demohlm.hardware.processes import GO, run_process
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.hardware.single import ControllerLock
from lerobot_demohlm.hardware.slots import Reading

READY_S = 600.0  # that processes may take to load
ASK_AGAIN_S = 1.0  # after which a robot that does not run is asked to again
OPERATOR_S = 0.05  # between signs of life of the operator
TURN_S = 0.3  # that a loop which reads keys may take for a turn
FACTS = "deployment.json"


class Deployment:
    """The processes of a deployment, and the operator's slot.

    Args:
        settings: What is deployed.
        before_control: Called when all but the controller is ready, before that begins; nothing by default.

    Attributes:
        folder: Of the slots.
        processes: By name: control, policy, pose, servos, recorder.

    Raises:
        DemoHLMError: What a process refused; nothing has been sent then.
    """

    def __init__(self, settings: DeploymentSettings, before_control: Callable[[], None] = lambda: None) -> None:
        self.settings = settings
        self._lock_on_robot = ControllerLock(settings.interface, settings.domain)  # before any port is opened
        memory = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(prefix="demohlm-", dir=memory if memory.is_dir() else None))
        self.processes: dict[str, BaseProcess] = {}
        self._slots = {name: records.slot(self.folder, name) for name in records.RECORDS}
        self._mode, self._number, self._estop, self._closed = Mode.DAMP, 0, "", False
        self._quiet = threading.Event()
        self._began, self._over, self._turned_s = False, False, math.nan
        self._identity: dict[str, Any] = {}
        atexit.register(self.close)  # before multiprocessing waits for processes that nobody has ended
        self._lock = threading.Lock()
        try:
            for name in (*self._names(), "control"):
                self._start(name)
            self._wait_for_ready(*self._names())
            self._identity = {} if settings.root is None else _identify(settings)
            before_control()
            (self.folder / GO).touch()
            self._wait_for_ready("control")
            self._began = True
            self._write_facts()  # also of a deployment whose end nobody can write any more
        except BaseException:
            self.close()
            if settings.root is not None:
                with suppress(OSError):  # it holds a record, or was never made
                    settings.root.rmdir()
            raise
        self._operating = threading.Thread(target=self._operate, name="operator", daemon=True)
        self._operating.start()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def request(self, mode: Mode) -> None:
        """Ask the controller for a mode; it may refuse, and says why in its slot."""
        with self._lock:
            self._mode, self._number = mode, self._number + 1
            if mode == Mode.STAND:
                self._estop = ""
        self._say()

    def estop(self, source: str) -> None:
        """Brake all motors; only a request to stand lifts it."""
        with self._lock:
            self._mode, self._number, self._estop = Mode.DAMP, self._number + 1, source
        self._say()

    def note_turn(self) -> None:
        """Say that the loop which reads the operator's keys goes on.

        From the first time on, the operator counts as silent once it has not for ``TURN_S``: a loop that waits for its
        terminal hears no e-stop.
        """
        self._turned_s = time.monotonic()

    def write_command(self, wanted: np.ndarray, run_ns: int, step: int) -> None:
        """Take the place of a policy: hand a command (23,) to the controller, for the run that began at a time.

        Raises:
            RobotError: A policy's process writes them.
        """
        if self.settings.policy is not None:
            raise RobotError("commands beside a policy's", "one source of commands", "deploy without a policy")
        self._slots["policy"].write(records.record("policy", command=wanted, run_ns=run_ns, step=step))

    def read(self, name: str) -> Reading | None:
        """Return the newest of a slot."""
        return self._slots[name].read()

    @property
    def mode(self) -> Mode:
        """What the robot does."""
        reading = self._slots["control"].read()
        return Mode.DAMP if reading is None else Mode(int(reading.value["mode"]))

    @property
    def reason(self) -> str:
        """Why it does that."""
        reading = self._slots["control"].read()
        return "" if reading is None else records.text(reading.value["reason"])

    @property
    def since_ns(self) -> int:
        """When that began [ns, ``time.monotonic_ns``]."""
        reading = self._slots["control"].read()
        return 0 if reading is None else int(reading.value["since_ns"])

    @property
    def standing(self) -> bool:
        """Whether the robot balances: the ramp of STAND is over."""
        reading = self._slots["control"].read()
        return reading is not None and bool(reading.value["standing"])

    def check(self) -> None:
        """Raise what a process has died of.

        Raises:
            DemoHLMError: What it refused.
        """
        for name, process in self.processes.items():
            if process.exitcode is not None:
                self._raise(name, process.exitcode)

    def forget_ended(self) -> None:
        """Look no longer after processes that have ended; the controller's watchdogs answer for them."""
        self.processes = {name: each for name, each in self.processes.items() if each.exitcode is None}

    def wait_for(self, mode: Mode, timeout_s: float, *, standing: bool = False) -> None:
        """Wait until the robot is in a mode.

        Raises:
            RobotError: It is not within the time.
        """
        until = time.monotonic() + timeout_s
        while self.mode != mode or (standing and not self.standing):
            if time.monotonic() > until:
                raise RobotError(f"{self.mode.name}: {self.reason}", mode.name, "see what holds it back")
            time.sleep(0.005)

    def run(self, timeout_s: float) -> None:
        """Run; asks again while something is missing that may still come, such as an object that is not found yet.

        Raises:
            RobotError: It does not run within the time.
        """
        until = time.monotonic() + timeout_s
        while True:
            self.request(Mode.RUN)
            try:
                self.wait_for(Mode.RUN, min(ASK_AGAIN_S, timeout_s))
            except RobotError:
                if time.monotonic() > until or self.mode == Mode.DAMP:  # out of DAMP leads only STAND
                    raise
            else:
                return

    def apply(self, fault: Fault) -> None:
        """Have something happen to a process: "kill", "stop" or "full_disk"."""
        if fault.process == "operator":
            self._quiet.set()
            return
        pid = self.processes["recorder" if fault.kind == "full_disk" else fault.process].pid
        assert pid is not None
        if fault.kind == "full_disk":
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, 0))
        else:
            os.kill(pid, signal.SIGKILL if fault.kind == "kill" else signal.SIGSTOP)

    def close(self) -> None:
        """Brake the motors, then end all processes; the controller first, the recorder last."""
        if self._over:
            return
        self._closed = True
        order = ("control", "policy", "pose", "servos", "recorder")
        for name in order:
            process = self.processes.get(name)
            if process is None or process.pid is None:
                continue
            if process.is_alive():
                os.kill(process.pid, signal.SIGCONT)  # one that was stopped could not end
                process.terminate()
            process.join(5.0)
            if process.is_alive():
                process.kill()
                process.join(5.0)
        self._write_facts(ended=True)
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock_on_robot.release()
        atexit.unregister(self.close)
        self._over = True  # an interrupted one is not, and may be called again

    def _names(self) -> list[str]:
        settings = self.settings
        names = ["policy"] if settings.policy is not None else []
        names += ["pose"]
        names += ["servos"] if settings.servo_port is not None else []
        return names + (["recorder"] if settings.root is not None else [])

    def _start(self, name: str) -> None:
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=run_process, args=(name, self.settings, self.folder), name=name)
        process.start()
        self.processes[name] = process

    def _wait_for_ready(self, *names: str) -> None:
        until = time.monotonic() + READY_S
        while missing := [name for name in names if not (self.folder / f"{name}.ready").exists()]:
            self.check()
            if time.monotonic() > until:
                raise RobotError(f"{', '.join(missing)} not ready after {READY_S:g} s", "all processes", "try again")
            time.sleep(0.02)

    def _raise(self, name: str, code: int) -> None:
        try:
            content = json.loads((self.folder / f"{name}.error").read_text())
        except (OSError, ValueError):
            raise RobotError(f"the process {name} ended ({code})", "one that stays", "see its message") from None
        raise RobotError(content["got"], content["expected"], content["remedy"])

    def _operate(self) -> None:
        """Give signs of life, as long as this process lives, and its loop goes on where one does."""
        while not self._closed:
            hangs = time.monotonic() - self._turned_s > TURN_S  # never where no turn was noted
            if not self._quiet.is_set() and not hangs:
                self._say()
            time.sleep(OPERATOR_S)

    def _say(self) -> None:
        with self._lock:
            value = records.record(
                "operator", mode=self._mode, number=self._number, estop=bool(self._estop), source=self._estop.encode()
            )
            self._slots["operator"].write(value)

    def _write_facts(self, *, ended: bool = False) -> None:
        """Write what is deployed beside its record, and how it has ended."""
        root = self.settings.root
        if root is None or not self._began:
            return
        settings = self.settings
        facts: dict[str, Any] = {
            "task": get_task(settings.task).name, "region": settings.region, "interface": settings.interface,
            "pose_source": settings.pose_source, **self._identity,
            "mode": self.mode.name if ended else None, "reason": self.reason if ended else "",
        }  # fmt: skip
        try:
            replace_text(root / FACTS, json.dumps(facts, indent=1) + "\n")
        except OSError:
            return  # a full disk; the recorder has said so


def _identify(settings: DeploymentSettings) -> dict[str, Any]:
    """Return which policy is deployed, where it is, and which controller."""
    policy, weights = settings.policy, settings.weights or controllers.find(controllers.DEFAULT)
    return {
        "policy": None if policy is None else str(policy.resolve()),
        "policy_hash": None if policy is None else policy_hash(policy),
        "controller": hashlib.sha256(weights.read_bytes()).hexdigest(),
    }
