"""Robot, policy, poses and operator -> LowCmd at 50 Hz: the one process that writes to the motors.

The controller is the one of training and simulation (``WholeBodyController``), in the same ticks. Between ticks the
process looks every 4 ms whether something has happened that must be answered at once. It brakes all motors before it
ends, however it is asked to.
"""

import math
import multiprocessing
import signal
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gym_demohlm.control import command
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.errors import CommandError
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.timing import CONTROL_DT
from lerobot_demohlm.hardware import records, remote, robot_observation
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.following import CommandFollower, NeckFollower, Search
from lerobot_demohlm.hardware.layout import MODE_MACHINE_29, NUM_JOINTS, LowCmd
from lerobot_demohlm.hardware.limits import COMMAND_TIMEOUT_S, RAMP_S, Ages, Limits
from lerobot_demohlm.hardware.link import DOMAIN, LOW_CMD, LOW_STATE, Link, Reader
from lerobot_demohlm.hardware.machine import Request, StateMachine, Watched
from lerobot_demohlm.hardware.odometry import LegOdometry
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.hardware.safety import SafetyFilter, Wanted
from lerobot_demohlm.hardware.state_watch import StateWatch
from lerobot_demohlm.hardware.wire import CommandWire

SLICE_S = 0.004  # between looks at robot and operator
LISTEN_S = 0.5  # for commands of others, before the first of ours
FAREWELL = 15  # commands that brake the motors at the end
_ENDS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # Linux's goes on while the machine is suspended


@dataclass(frozen=True, kw_only=True)
class ControlSettings:
    """What the control process needs to know.

    Attributes:
        interface: Of the network.
        folder: Of the slots.
        task: Whose hands the robot has and where its neck looks.
        domain: Of DDS.
        weights: File of the controller; the packaged one by default.
        servos: Whether neck and grippers have a process of their own.
        recorded: Whether a recorder is expected to keep up.
        policy: Whether a policy has a process of its own, which gives signs of life while it waits.
        limits: Of commands and measurements.
        ages: Of the watchdogs.
    """

    interface: str
    folder: Path
    task: str
    domain: int = DOMAIN
    weights: Path | None = None
    servos: bool = True
    recorded: bool = True
    policy: bool = True
    limits: Limits = field(default_factory=Limits)
    ages: Ages = field(default_factory=Ages)


class ControlProcess:
    """Runs the controller of one robot.

    Args:
        settings: What it needs to know.

    Raises:
        RobotError: Somebody else commands this robot, or the network cannot be used.
    """

    def __init__(self, settings: ControlSettings) -> None:
        self._settings, task = settings, get_task(settings.task)
        link = Link(settings.interface, settings.domain)
        self._states = link.reader(LOW_STATE)
        refuse_other_controllers(link)
        refuse_other_robots(self._states, settings.interface)
        self._safety = SafetyFilter(settings.limits, task.hands)
        self._controller = WholeBodyController(1, settings.weights)
        gains = self._controller.settings
        self._kp, self._kd = np.array(gains.stiffness), np.array(gains.damping)
        self._gaze = [entry.name for entry in task.objects].index(task.gaze_target)
        self._search = Search(task)
        needed = {task.gaze_target, *task.searched}  # which the neck looks for before the robot runs
        self._needed = {index: entry.name for index, entry in enumerate(task.objects) if entry.name in needed}
        self._watch, self._odometry = StateWatch(settings.limits), LegOdometry()
        self._machine = StateMachine(limits=settings.limits, ages=settings.ages, sleep_limit=COMMAND_TIMEOUT_S)
        self._slots = {name: records.slot(settings.folder, name) for name in records.RECORDS}
        self._follower, self._neck = CommandFollower(command.rest()), NeckFollower()
        self._entered_ns, self._estop, self._stop = time.monotonic_ns(), "", False
        self._policy_number, self._policy_ns = 0, 0
        self._start, self._sent_q = g1.HOME.copy(), None
        self._looked_ns, self._ticks, self._late = time.clock_gettime_ns(_CLOCK), 0, 0
        self._wire = CommandWire(link, self._safety)

    def run(self) -> None:
        """Control the robot until a signal asks for the end; then brake its motors."""
        for number in _ENDS:
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        due, self._looked_ns = time.monotonic(), time.clock_gettime_ns(_CLOCK)
        parent = multiprocessing.parent_process()
        try:
            while not self._stop and (parent is None or parent.is_alive()):  # whoever started it may be killed
                if self._look() and self._machine.mode == Mode.DAMP:
                    self._send_damping()
                if time.monotonic() >= due:
                    self._late += time.monotonic() > due + 0.5 * CONTROL_DT
                    self._tick()
                    due = max(due + CONTROL_DT, time.monotonic())
                time.sleep(min(max(due - time.monotonic(), 0.0), SLICE_S))
        finally:
            for _ in range(FAREWELL):
                self._wire.damp(self._machine_mode)
                time.sleep(0.5 * CONTROL_DT)

    @property
    def _machine_mode(self) -> int:
        return self._watch.mode_machine or MODE_MACHINE_29

    def _look(self) -> bool:
        """Take in what has come, and decide; returns whether the mode has changed."""
        now_ns = time.clock_gettime_ns(_CLOCK)
        slept, self._looked_ns = 1e-9 * (now_ns - self._looked_ns), now_ns
        for message in self._states.take():
            if self._watch.take(message.content, may_restart=self._machine.mode == Mode.DAMP):
                self._tell_state()
        self._seen = self._observe(slept)
        if not self._machine.update(self._watch, self._seen, self._request(), self._sent_q):
            return False
        self._entered_ns = time.monotonic_ns()
        self._enter(self._machine.mode)
        return True

    def _request(self) -> Request:
        """Return what the operator asks for, and any e-stop that no request has lifted yet."""
        reading = self._slots["operator"].read()
        state = self._watch.state
        held = state is not None and remote.asks_to_stop(remote.buttons(state.remote))
        if reading is None:
            self._estop = "remote" if held else self._estop
            return Request(estop=self._estop)
        asked = reading.value
        lifted = int(asked["number"]) != self._machine._obeyed and int(asked["mode"]) == Mode.STAND
        if held:
            self._estop = "remote"
        elif bool(asked["estop"]):
            self._estop = records.text(asked["source"]) or "operator"
        elif lifted:
            self._estop = ""
        return Request(mode=Mode(int(asked["mode"])), number=int(asked["number"]), estop=self._estop)

    def _observe(self, slept: float) -> Watched:
        """Return the ages; before the first command of a run, the policy's counts from its beginning."""
        running = 1e-9 * (time.monotonic_ns() - self._entered_ns)
        policy = self._slots["policy"].read()
        if policy is not None and policy.number != self._policy_number:
            self._policy_number = policy.number
            self._take_command(policy.value, policy.time_ns)
        since_policy = 1e-9 * (time.monotonic_ns() - self._policy_ns)
        if self._machine.mode == Mode.RUN:
            since_policy = min(since_policy, running)
        elif self._settings.policy:
            since_policy = self._slots["policy"].age_s()
        else:
            since_policy = 0.0 if policy is not None else np.inf
        recorder, failed = self._slots["recorder"].read() if self._settings.recorded else None, ""
        if recorder is not None and bool(recorder.value["failed"]):
            failed = records.text(recorder.value["reason"])
        servos = self._slots["servos"].read() if self._settings.servos else None
        return Watched(
            state=self._watch.age_s,
            policy=since_policy,
            pose=self._slots["pose"].age_s(),
            servos=self._slots["servos"].age_s() if self._settings.servos else 0.0,
            servos_failed="" if servos is None else records.text(servos.value["reason"]),
            operator=self._slots["operator"].age_s(),
            recorder=self._slots["recorder"].age_s() if self._settings.recorded else 0.0,
            recorder_failed=failed,
            unseen=self._unseen(),
            slept=slept,
        )

    def _unseen(self) -> str:
        """Return the names of the needed objects that no look has shown yet; empty where there is no look at all."""
        pose = self._slots["pose"].read()
        if pose is None:
            return ""
        return ", ".join(name for index, name in self._needed.items() if not math.isfinite(pose.value["age_s"][index]))

    def _take_command(self, value: np.void, time_ns: int) -> None:
        """Follow a policy's command while running; one that is no command leaves the last one growing old."""
        if self._machine.mode != Mode.RUN or int(value["run_ns"]) != self._entered_ns:
            return
        with suppress(CommandError):
            self._follower.take(value["command"])
            self._policy_ns = time_ns

    def _enter(self, mode: Mode) -> None:
        """Begin a mode."""
        if mode == Mode.STAND:
            assert self._watch.state is not None
            self._start = self._watch.state.q[:NUM_JOINTS].astype(np.float64)
            self._follower, self._neck = CommandFollower(command.rest()), NeckFollower()
            self._search.begin()
        elif mode == Mode.HOLD:
            here = self._follower.now()
            here[command.VELOCITY] = 0.0
            self._follower = CommandFollower(here)

    def _tick(self) -> None:
        """Send one command, and tell the others."""
        began = time.perf_counter()
        self._ticks += 1
        mode, state = self._machine.mode, self._watch.state
        if mode == Mode.DAMP or state is None:
            self._send_damping()
            self._tell(self._follower.now(), began)
            return
        sensed = Proprioception(
            quat_wxyz=state.quat_wxyz[None].astype(np.float64),
            gyro=state.gyro[None].astype(np.float64),
            q=state.q[None, :NUM_JOINTS].astype(np.float64),
            dq=state.dq[None, :NUM_JOINTS].astype(np.float64),
        )
        if mode == Mode.STAND and not self._machine.standing:
            now, targets = self._ramp(sensed)
        else:
            now = self._follower.tick()
            targets = self._controller.step(sensed, now[None])[0]
        self._sent = self._wire.send(
            Wanted(q=targets, kp=self._kp, kd=self._kd), sensed.q[0], sensed.dq[0], self._machine_mode
        )
        self._sent_q = self._sent.q[:NUM_JOINTS].astype(np.float64)
        self._send_servos(now)
        self._tell(now, began, targets)

    def _ramp(self, sensed: Proprioception) -> tuple[np.ndarray, np.ndarray]:
        """Return command (23,) and targets (29,) on the way to the home pose; at its end the controller begins."""
        share = min(1e-9 * (time.monotonic_ns() - self._entered_ns) / RAMP_S, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        if share >= 1.0:
            self._controller.reset(np.array([0]), sensed)
            self._machine.standing = True
        return command.rest(), (1.0 - smooth) * self._start + smooth * g1.HOME

    def _send_damping(self) -> None:
        self._sent, self._sent_q = self._wire.damp(self._machine_mode), None
        self._slots["servo_goals"].write(records.record("servo_goals"))

    def _send_servos(self, now: np.ndarray) -> None:
        pose, state, servos = (self._slots[name].read() for name in ("pose", "state", "servos"))
        target, lost = None, self._seen.pose > self._settings.ages.pose
        if pose is not None and not lost:
            self._search.note(pose.value["valid"])
        found = pose is not None and math.isfinite(pose.value["age_s"][self._gaze])
        if pose is not None and state is not None and found and not lost:  # hidden: where it was, as in training
            seen = robot_observation.objects(pose.value, state.value, None if servos is None else servos.value)
            target = seen[self._gaze, :3, 3]
        missing = lost or not found or self._search.goes_on
        searches = missing and self._seen.policy < np.inf  # who has no policy needs no object
        neck = self._neck.tick(None if searches else target, searches=searches)
        goals = records.record("servo_goals", neck=neck, grippers=now[command.GRIPPERS], enabled=True)
        self._slots["servo_goals"].write(goals)

    def _tell_state(self) -> None:
        state = self._watch.state
        assert state is not None
        joints = slice(0, NUM_JOINTS)
        pelvis, torso = self._odometry.update(state.q[joints], state.quat_wxyz)
        value = records.record(
            "state", tick=state.tick, q=state.q[joints], dq=state.dq[joints], tau=state.tau[joints],
            quat_wxyz=state.quat_wxyz, gyro=state.gyro, accelerometer=state.accelerometer,
            temperature=state.temperature[joints].max(axis=1), mode_machine=state.mode_machine,
            buttons=remote.buttons(state.remote), T_odometry_pelvis=pelvis, T_odometry_torso=torso,
        )  # fmt: skip
        self._slots["state"].write(value, self._watch.time_ns)

    def _tell(self, now: np.ndarray, began: float, targets: np.ndarray | None = None) -> None:
        machine, seen, sent = self._machine, self._seen, self._sent
        joints = slice(0, NUM_JOINTS)
        value = records.record(
            "control", mode=machine.mode, reason=machine.reason.encode()[: records.REASON_SIZE],
            since_ns=self._entered_ns, standing=machine.standing, latched=bool(self._estop), command=now,
            wanted_q=sent.q[joints] if targets is None else targets, sent_q=sent.q[joints], kp=sent.kp[joints],
            kd=sent.kd[joints], state_age_s=seen.state, policy_age_s=seen.policy, pose_age_s=seen.pose,
            servos_age_s=seen.servos, operator_age_s=seen.operator, recorder_age_s=seen.recorder,
            tilt=self._watch.tilt, changed=changed_bits(self._safety.changed),
            refused_states=sum(self._watch.refused.values()), ticks=self._ticks, late_ticks=self._late,
            compute_s=time.perf_counter() - began,
        )  # fmt: skip
        self._slots["control"].write(value)


CHANGES = ("finite", "step", "joint", "self_collision", "gain", "torque")
"""Names of the bits in ``changed`` of the record "control"."""


def changed_bits(names: tuple[str, ...]) -> int:
    """Return the bits of what the safety filter changed."""
    return sum(1 << CHANGES.index(name) for name in names)


def refuse_other_controllers(link: Link) -> None:
    """Listen for commands of others.

    Raises:
        RobotError: Somebody commands this robot.
    """
    reader, until, heard = link.reader(LOW_CMD), time.monotonic() + LISTEN_S, 0
    while time.monotonic() < until:
        heard += sum(LowCmd(message.content).is_sound() for message in reader.take())
        if heard:
            raise RobotError(
                f"commands of another controller on {link.interface}", "one controller",
                "stop the other one, or the robot's own: release it with --release",
            )  # fmt: skip
        time.sleep(0.01)


def refuse_other_robots(states: Reader, interface: str) -> None:
    """Count who speaks as a robot; the network has had ``LISTEN_S`` to tell.

    Raises:
        RobotError: More than one does.
    """
    speaking = states.writers()
    if speaking > 1:
        raise RobotError(
            f"{speaking} robots on {interface}", "one",
            "switch the others off; one that has just gone is known for ten seconds more",
        )  # fmt: skip
