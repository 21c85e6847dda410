"""Wanted joint targets -> a LowCmd that may go to the motors. What is refused is held back, scaled down or frozen.

In this order: arms that would enter the body keep their last targets; targets move by no more than a step and stay in
their ranges; where the PD would ask a motor for more torque than it may give, its gains are scaled down until it does
not. So every command is within each limit, whatever was asked for.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from gym_demohlm.robot import g1, hands
from gym_demohlm.robot.physics import SECOND
from gym_demohlm.robot.robot import robot_spec
from lerobot_demohlm.hardware.layout import ENABLED, MODE_PR, NUM_JOINTS, LowCmd
from lerobot_demohlm.hardware.limits import ARMS, DAMPING, Limits


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What a controller wants of the motors.

    Attributes:
        q: (29,) targets [rad].
        kp: (29,) [Nm/rad].
        kd: (29,) [Nms/rad].
    """

    q: np.ndarray
    kp: np.ndarray
    kd: np.ndarray


class BodyCheck:
    """Whether arms at some joint positions would enter trunk, legs or each other.

    Args:
        kind: Hands of the robot, "rubber" or "gripper".
    """

    def __init__(self, kind: hands.Hands) -> None:
        self._model = model = robot_spec(kind, SECOND).compile()
        self._data = mujoco.MjData(model)
        self._addresses = [int(model.joint(f"{joint}_joint").qposadr[0]) for joint in g1.BODY_JOINTS]
        shoulders = {f"{side}_shoulder_pitch_link" for side in g1.SIDES}
        self._of_arm = np.zeros(model.nbody, bool)
        for body in range(model.nbody):
            up = body
            while up and not self._of_arm[body]:
                self._of_arm[body] = model.body(up).name in shoulders
                up = int(model.body_parentid[up])

    def overlap(self, q: np.ndarray) -> tuple[float, str]:
        """Return how deep shapes of an arm enter other shapes of the robot [m], and which they are; 0 for not at all.

        Args:
            q: (29,) joint positions [rad].
        """
        model, data = self._model, self._data
        data.qpos[self._addresses] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        deepest, between = 0.0, ""
        for contact in data.contact[: data.ncon]:
            first, second = (int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2))
            if -contact.dist > deepest and (self._of_arm[first] or self._of_arm[second]):
                deepest, between = float(-contact.dist), f"{model.body(first).name} and {model.body(second).name}"
        return deepest, between


class SafetyFilter:
    """Makes every command that reaches the motors.

    Args:
        limits: What may be told.
        kind: Hands of the robot.

    Attributes:
        changed: Names of the limits that the last command met: "finite", "self_collision", "step", "joint", "gain",
            "torque".
    """

    def __init__(self, limits: Limits, kind: hands.Hands) -> None:
        self.limits = limits
        self._body = BodyCheck(kind)
        self._last: np.ndarray | None = None
        self.changed: tuple[str, ...] = ()

    def damp(self, mode_machine: int) -> LowCmd:
        """Return a command that brakes every motor and holds none."""
        self._last, self.changed = None, ()
        message = _message(mode_machine)
        message.kd[:NUM_JOINTS] = DAMPING
        message.seal()
        return message

    def __call__(self, wanted: Wanted, q: np.ndarray, dq: np.ndarray, mode_machine: int) -> LowCmd:
        """Return the command.

        Args:
            wanted: By a controller.
            q: (29,) measured positions [rad].
            dq: (29,) measured velocities [rad/s].
            mode_machine: Of the robot.
        """
        limits, changed = self.limits, []
        last = np.clip(q, *limits.ranges.T) if self._last is None else self._last
        if not all(np.isfinite(values).all() for values in (wanted.q, wanted.kp, wanted.kd)):
            changed.append("finite")
            wanted = Wanted(q=last, kp=np.zeros(NUM_JOINTS), kd=np.full(NUM_JOINTS, DAMPING))
        target = np.array(wanted.q, dtype=np.float64)
        stepped = np.clip(target, last - limits.step, last + limits.step)
        inside = np.clip(stepped, *limits.ranges.T)
        _note(changed, "step", stepped, target)
        _note(changed, "joint", inside, stepped)
        deeper, _ = self._body.overlap(inside)
        if deeper > limits.overlap:
            kept = inside.copy()
            kept[ARMS] = last[ARMS]
            if deeper >= self._body.overlap(kept)[0]:  # a way out of an overlap is free
                inside = kept
                changed.append("self_collision")
        kp, kd = np.clip(wanted.kp, 0.0, limits.max_kp), np.clip(wanted.kd, 0.0, limits.max_kd)
        _note(changed, "gain", np.append(kp, kd), np.append(wanted.kp, wanted.kd))
        sent = inside.astype(np.float32).astype(np.float64)
        torque = np.abs(kp * (sent - q) - kd * dq)
        share = np.minimum(1.0, 0.999 * limits.torque / np.maximum(torque, 1e-9))
        if (share < 1.0).any():
            changed.append("torque")
        self._last, self.changed = inside, tuple(changed)
        message = _message(mode_machine)
        message.q[:NUM_JOINTS], message.kp[:NUM_JOINTS], message.kd[:NUM_JOINTS] = inside, share * kp, share * kd
        message.seal()
        return message


def _note(changed: list[str], name: str, after: np.ndarray, before: np.ndarray) -> None:
    if (np.abs(after - before) > 1e-9).any():
        changed.append(name)


def _message(mode_machine: int) -> LowCmd:
    message = LowCmd()
    message.mode_pr, message.mode_machine = MODE_PR, mode_machine
    message.mode = np.append(np.full(NUM_JOINTS, ENABLED), np.zeros(len(message.q) - NUM_JOINTS, int))
    return message
