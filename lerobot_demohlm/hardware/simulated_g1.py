"""A G1 in MuJoCo that speaks the robot's own protocol: a process of its own at the other end of the network.

The physics is ``Simulation``'s: a stand-in for its thread pool makes the same steps of 2 ms, one at a time against the
clock, with torques from the newest LowCmd instead of a controller of its own. Between them it says LowState. Like the
robot it refuses wrong checksums and commands for other machines, and damps by itself when commands stop.

A gantry holds the pelvis until the joints have been held for a while, and takes the robot back once they are not.
"""

import json
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gym_demohlm.control import command, controllers
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.envs.episode import max_episode_steps
from gym_demohlm.registry import get_task
from gym_demohlm.robot.hands import GRIPPER
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.judge import Judge, outcome
from gym_demohlm.simulation.worlds import STATE_SPEC
from gym_demohlm.task import DEFAULT_REGION, WIDEST, InitialState
from gym_demohlm.timing import PHYSICS_DT
from gym_demohlm.variation import NONE, get_variation
from lerobot_demohlm.hardware import servo_units, world_topic
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.faults import Fault, Faults, FaultyLine, FaultySensors
from lerobot_demohlm.hardware.layout import MODE_MACHINE_29, NUM_JOINTS, LowState
from lerobot_demohlm.hardware.limits import Limits
from lerobot_demohlm.hardware.link import DOMAIN, LOW_CMD, LOW_STATE, WORLD, Link
from lerobot_demohlm.hardware.motion_switcher import MotionSwitcherService
from lerobot_demohlm.hardware.motors import Motors
from lerobot_demohlm.hardware.priority import Urgency, hurry
from lerobot_demohlm.hardware.simulated_bus import SimulatedBus
from lerobot_demohlm.hardware.wire_watch import WireWatch

WORLD_EVERY = 20  # physics steps: 25 Hz
_LAG_S = 0.1  # a robot later than this begins a new schedule
_LIMP_S = 1.0  # joints not held for so long: the gantry takes the robot back
_CONTROL_SPEC = (
    mujoco.mjtState.mjSTATE_CTRL.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)


@dataclass(frozen=True, kw_only=True)
class SimulatedSettings:
    """A robot and its world.

    Attributes:
        task: Name of the task.
        interface: Of the network.
        domain: Of DDS.
        region: From which each episode's start is drawn.
        seed: Of the first start; the next episode has the next seed.
        start: Of every episode; drawn from the region by default.
        servo_link: Path that leads to the serial port of neck and grippers; none by default.
        faults: What goes wrong; starts have these by turns.
        noise: Of joints [rad], their velocities [rad/s] and the gyro [rad/s], as a share of the usual one.
        gantry_s: How long the joints must be held before the gantry lets go [s].
        own_controller: Name of the robot's own controller that runs at first, see ``motion_switcher``.
        episodes: After which it ends; 0 for never.
        controller: Whose physics the robot has, see ``gym_demohlm.control.controllers``.
        variation: How each episode's robot differs, see ``get_variation``; of the group ``robot`` only what its body
            has: strength, masses and friction. Its gains are those of each command, and its sensors have ``noise``.

    Raises:
        UnknownNameError: There is no such variation.
        RobotError: It varies something else than the robot, or objects have other shapes in that region: the eyes of a
            deployment know the plain world.
    """

    task: str
    interface: str
    domain: int = DOMAIN
    region: str = DEFAULT_REGION
    seed: int = 0
    start: InitialState | None = None
    servo_link: Path | None = None
    faults: tuple[Faults, ...] = (Faults(),)
    noise: float = 1.0
    gantry_s: float = 3.5
    own_controller: str = ""
    episodes: int = 0
    controller: str = controllers.DEFAULT
    variation: str = NONE.name

    def __post_init__(self) -> None:
        """Check region and variation."""
        task = get_task(self.task)
        task.region(self.region)
        if self.region == WIDEST and task.wide_form is not None:
            expected = ", ".join(region for region in task.regions if region != WIDEST)
            raise RobotError(
                f"{self.region} of {task.name}, where objects have other shapes, which a deployment's eyes do not know",
                expected,
                "choose another --region",
            )
        others = [group for group in get_variation(self.variation).groups if group != "robot"]
        if others:
            got = f"the variation {self.variation!r} of {', '.join(others)}"
            raise RobotError(got, "the group robot alone", "write it as real:robot")


_NOISE_Q, _NOISE_DQ, _NOISE_GYRO = 0.0005, 0.02, 0.01


class _Remote(WholeBodyController):
    """What ``Simulation`` takes for its controller: it brings its physics; the one that acts is across the network."""

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Do nothing."""

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Return targets that nobody reads."""
        return np.zeros((1, NUM_JOINTS))


class SimulatedG1:
    """One robot in the world of a task.

    Args:
        settings: Robot and world.
        say: Called with each thing that happens: "hangs", "free", "damped", "hung_again", "episode", "fault".

    Attributes:
        sim: Its world; only ``run`` may step it.
        counts: Of states sent, and of those that were late by more than 2 ms.
        watch: Of what it was told.
    """

    def __init__(self, settings: SimulatedSettings, say: Callable[[dict[str, Any]], None]) -> None:
        self._settings, self._say = settings, say
        self._task = task = get_task(settings.task)
        link = Link(settings.interface, settings.domain)
        self._commands, self._states = link.reader(LOW_CMD, newest=False), link.writer(LOW_STATE)
        self._worlds, self._switcher = link.writer(WORLD), MotionSwitcherService(link, settings.own_controller)
        servos = servo_units.NECK + (servo_units.GRIPPERS if task.hands == "gripper" else ())
        self._bus = SimulatedBus(servos)
        if settings.servo_link is not None:
            self._bus.link(settings.servo_link)
        self.watch, self._motors = WireWatch(Limits(), MODE_MACHINE_29), Motors()
        self._rng = np.random.default_rng([281, settings.seed])
        self.counts = {"states": 0, "late": 0, "gaps": 0}
        self._state, self._number, self._stop = LowState(), 0, False
        self._state.mode_machine, self._state.mode = MODE_MACHINE_29, 1
        self._episode, self._due = -1, time.monotonic()
        self._neck, self._jaws = np.zeros(2), np.zeros(2)
        self._last_command = 0.0
        self._gaps: list[float] = []
        self.sim = Simulation(
            task,
            controller=_Remote(1, controllers.find(settings.controller)),
            pool=self,
            variation=get_variation(settings.variation),
        )
        self._judge = Judge(self.sim)
        self._hang()

    # What Simulation asks of its pool.

    def rollout(
        self,
        models: Sequence[mujoco.MjModel],
        data: Sequence[mujoco.MjData],
        before: np.ndarray,
        control: np.ndarray,
        *,
        control_spec: int,
        skip_checks: bool,
        nstep: int,
        state: np.ndarray,
        sensordata: np.ndarray,
    ) -> None:
        """Make the steps of one tick, one by one against the clock; see ``mujoco.rollout.Rollout.rollout``."""
        model, now = models[0], data[0]
        mujoco.mj_setState(model, now, before[0], STATE_SPEC)
        mujoco.mj_setState(model, now, control[0, 0], control_spec)
        now.qacc_warmstart[:] = 0.0
        for index in range(nstep):
            self._hear(now)
            self._motors.drive(model, now)
            self._turn_servos(now)
            mujoco.mj_step(model, now)
            self._support(now)
            mujoco.mj_getState(model, now, state[0, index], STATE_SPEC)
            sensordata[0, index] = now.sensordata
            self._speak(model, now)
            self._wait()

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()

    def run(self) -> dict[str, Any]:
        """Be a robot until a signal asks for the end, or the episodes are over; returns what was counted."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: setattr(self, "_stop", True))
        self._due = time.monotonic()
        wanted, limp_since = command.rest(), 0.0
        while not self._stop:
            wanted[command.GRIPPERS] = self._jaws / GRIPPER.stroke
            result = self.sim.step(wanted[None])
            free = self._free_since is not None
            if free:
                self._judge.watch(result, np.array([True]))
                self._steps += 1
                self._finish_if_over()
            limp_since = (limp_since or time.monotonic()) if not self._motors.held else 0.0
            if free and limp_since and time.monotonic() - limp_since > _LIMP_S:
                self._finish("damped")
                if self._settings.episodes and self._episode + 1 >= self._settings.episodes:
                    break
                self._hang()
                limp_since = 0.0
            self._switcher.serve()
        self.sim.close()
        return self.summary()

    def summary(self) -> dict[str, Any]:
        """Return what was counted: states, commands, gaps between these [ms], violations."""
        gaps = 1e3 * np.array(self._gaps or [0.0])
        return {
            **self.counts,
            **{name: self.watch.counts[name] for name in ("executed", "bad_crc", "other_machine")},
            "violations": self.watch.violations,
            "worst": {name: round(value, 6) for name, value in self.watch.worst.items()},
            "gap_p50_ms": round(float(np.percentile(gaps, 50)), 2),
            "gap_p99_ms": round(float(np.percentile(gaps, 99)), 2),
            "gap_max_ms": round(float(gaps.max()), 2),
            "gaps_over_40_ms": int((gaps > 40.0).sum()),
        }

    def _hang(self) -> None:
        """Begin the next episode in the gantry."""
        self._episode += 1
        self._faults = self._settings.faults[self._episode % len(self._settings.faults)]
        self._sensors, self._line = FaultySensors(self._faults), FaultyLine(self._faults)
        self._announced: set[Fault] = set()
        self._pushed: set[Fault] = set()
        start = self._settings.start or self._task.sample(
            self._settings.region, np.random.default_rng(self._settings.seed + self._episode)
        )
        start = self.sim.vary(start)
        self.sim.reset([start])
        self._judge.reset(np.array([0]))
        qpos = self.sim.qpos[0]
        base = self.sim.scene.base_qpos
        self._pelvis = qpos[base : base + 7].copy()
        self._free_since: float | None = None
        self._held_since: float | None = None
        self._steps, self._finished, self._was_damped = 0, False, True
        self._start = start
        self._tell("hangs", start=start, **self.summary())

    def _finish_if_over(self) -> None:
        judge = self._judge
        if judge.success_held[0] or judge.fell[0] or judge.unstable[0]:
            self._finish("")
        elif self._steps >= max_episode_steps(self._task):
            self._finish("")

    def _finish(self, why: str) -> None:
        """Say once how the episode has ended."""
        if self._finished:
            return
        self._finished = True
        faults = {name: bool(flags[0]) for name, flags in self._judge.faults().items()}
        self._tell(
            "episode", seed=self._settings.seed + self._episode,
            outcome=outcome(bool(self._judge.success_held[0]), faults), length_s=round(0.1 * self._steps, 1),
            ended_by=why, start=self._start, **self.summary(),
        )  # fmt: skip

    @property
    def _time_s(self) -> float:
        """Time since the robot stands free [s]; below 0 before."""
        return -1.0 if self._free_since is None else time.monotonic() - self._free_since

    def _hear(self, data: mujoco.MjData) -> None:
        for message in self._commands.take():
            scene = self.sim.scene
            told = self.watch.take(message.content, data.qpos[scene.body_qpos], data.qvel[scene.body_qvel])
            if told is not None:
                now = time.monotonic()
                if self._last_command and not self._motors.damped:
                    self._gaps.append(now - self._last_command)
                self._last_command = now
                self._motors.obey(told)

    def _turn_servos(self, data: mujoco.MjData) -> None:
        scene = self.sim.scene
        for index, servo in enumerate(servo_units.NECK):
            if self._bus.holds(servo):
                self._neck[index] = self._bus.goal(servo)
        data.ctrl[NUM_JOINTS : NUM_JOINTS + 2] = self._neck
        if scene.num_grippers:
            for index, servo in enumerate(servo_units.GRIPPERS):
                if self._bus.holds(servo):
                    self._jaws[index] = self._bus.goal(servo)
            data.ctrl[NUM_JOINTS + 2 : NUM_JOINTS + 4] = self._jaws / GRIPPER.stroke

    def _support(self, data: mujoco.MjData) -> None:
        """Hold the pelvis while the robot hangs; let go once its joints have been held for long enough."""
        now, scene = time.monotonic(), self.sim.scene
        if self._motors.damped != self._was_damped:
            self._was_damped = self._motors.damped
            if self._was_damped:
                self._tell("damped", silence_ms=round(1e3 * self._motors.silence_s, 2))
        self._held_since = (self._held_since or now) if self._motors.held else None
        if self._free_since is not None:
            return
        data.qpos[scene.base_qpos : scene.base_qpos + 7] = self._pelvis
        data.qvel[scene.base_qvel : scene.base_qvel + 6] = 0.0
        if self._held_since is not None and now - self._held_since > self._settings.gantry_s:
            self._free_since = now
            self._tell("free")

    def _speak(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Say LowState, and show the world to pose sources."""
        scene, state, rng, noise = self.sim.scene, self._state, self._rng, self._settings.noise
        joints, time_s = slice(0, NUM_JOINTS), self._time_s
        draws = noise * rng.standard_normal(2 * NUM_JOINTS + 3)
        state.q[joints] = data.qpos[scene.body_qpos] + _NOISE_Q * draws[joints]
        state.dq[joints] = data.qvel[scene.body_qvel] + _NOISE_DQ * draws[NUM_JOINTS : 2 * NUM_JOINTS]
        state.tau[joints] = data.actuator_force[joints]
        base, speed = scene.base_qpos, scene.base_qvel
        state.quat_wxyz[:] = data.qpos[base + 3 : base + 7]
        state.gyro[:] = data.qvel[speed + 3 : speed + 6] + _NOISE_GYRO * draws[-3:]
        felt = data.qacc[speed : speed + 3] * (self._free_since is not None) - model.opt.gravity
        rotation = data.xmat[model.body("pelvis").id].reshape(3, 3)
        state.accelerometer[:] = felt @ rotation
        state.temperature[joints] = 35
        state.remote[:] = 0
        self._number += 1
        state.tick, state.mode_machine = self._number, MODE_MACHINE_29
        self._sensors.spoil(state, time_s, PHYSICS_DT)
        state.seal()
        for message in self._line.carry(state.to_bytes(), time_s):
            self._states.send(message)
        self._shove(data, time_s)
        if self._number % WORLD_EVERY == 0:
            self._show(model, data, time_s)
        self.counts["states"] += 1
        for fault in self._faults.faults:
            if fault.active(time_s) and fault not in self._announced:
                self._announced.add(fault)
                self._tell("fault", kind=fault.kind)

    def _shove(self, data: mujoco.MjData, time_s: float) -> None:
        for fault in self._faults.now(time_s, "push"):
            if fault not in self._pushed:
                self._pushed.add(fault)
                data.qvel[self.sim.scene.base_qvel + 1] += fault.amount

    def _show(self, model: mujoco.MjModel, data: mujoco.MjData, time_s: float) -> None:
        for index, servo in enumerate(servo_units.NECK):
            scene = self.sim.scene
            place, speed = data.qpos[scene.neck_qpos[index]], data.qvel[scene.neck_qvel[index]]
            self._bus.set_present(servo, float(place), float(speed))
        for index, servo in enumerate(servo_units.GRIPPERS[: self.sim.scene.num_grippers]):
            scene = self.sim.scene
            place, speed = data.qpos[scene.jaw_qpos[index]], data.qvel[scene.jaw_qvel[index]]
            self._bus.set_present(servo, float(place), float(speed))
        if self._faults.now(time_s, "pose_dropout"):
            return
        physics = np.empty(mujoco.mj_stateSize(model, STATE_SPEC))
        mujoco.mj_getState(model, data, physics, STATE_SPEC)
        mocap = np.concatenate([data.mocap_pos.ravel(), data.mocap_quat.ravel()])
        self._worlds.send(world_topic.pack(self._episode, float(data.time), physics, mocap))

    def _wait(self) -> None:
        """Wait until the next step is due."""
        self._due += PHYSICS_DT
        ahead = self._due - time.monotonic()
        if ahead > 0.0:
            time.sleep(ahead)
            ahead = self._due - time.monotonic()
        self.counts["late"] += ahead < -PHYSICS_DT
        if ahead < -_LAG_S:
            self.counts["gaps"] += 1
            self._due = time.monotonic()

    def _tell(self, event: str, **facts: Any) -> None:  # noqa: ANN401
        self._say({"event": event, "time_s": round(time.monotonic(), 4), "episode_number": self._episode, **facts})


def run(settings: SimulatedSettings, output: Any = None) -> dict[str, Any]:  # noqa: ANN401
    """Be a robot; says what happens as JSON lines on stdout, or in a stream."""
    stream = output or sys.stdout
    hurry(Urgency.CONTROL)

    def say(event: dict[str, Any]) -> None:
        print(json.dumps(event), file=stream, flush=True)

    robot = SimulatedG1(settings, say)
    return robot.run()
