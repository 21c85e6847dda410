"""What is known of robot, processes and operator -> DAMP, STAND, RUN or HOLD, with the reason.

What cannot be survived on two legs damps: no state, a fall, a joint too fast, a motor too hot, an e-stop. What leaves
the robot its balance holds: no policy, no pose, no servos, nobody who could stop it, no record. Out of HOLD leads only
the operator; out of DAMP only the operator, and by way of STAND.
"""

from dataclasses import dataclass, field

import numpy as np

from gym_demohlm.robot import g1
from lerobot_demohlm.hardware.layout import MODE_MACHINE_29
from lerobot_demohlm.hardware.limits import ARMS, Ages, Limits
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.hardware.state_watch import StateWatch


@dataclass(frozen=True, kw_only=True)
class Request:
    """What the operator has asked for last.

    Attributes:
        mode: The mode.
        number: Of the request; each is obeyed once.
        estop: What stops the robot, such as "key"; empty for nothing. It stays until a request after it.
    """

    mode: Mode = Mode.DAMP
    number: int = 0
    estop: str = ""


@dataclass(frozen=True, kw_only=True)
class Watched:
    """What the watchdogs look at; ages in s, infinite for what has never spoken.

    Attributes:
        state: Of the robot.
        policy: Of the policy's newest command.
        pose: Of the newest look at the objects.
        servos: Of neck and grippers; 0 where there are none.
        operator: Of the operator's newest sign of life.
        recorder: Of the recorder's; 0 where nothing is recorded.
        recorder_failed: Why the recorder cannot write; empty while it can.
        servos_failed: Why neck or grippers do not hold; empty while they do.
        unseen: Names of the objects that have to be found first and were never seen; empty once all were.
        slept: Since the control process itself last looked.
    """

    state: float
    policy: float
    pose: float
    servos: float
    operator: float
    recorder: float
    recorder_failed: str = ""
    servos_failed: str = ""
    unseen: str = ""
    slept: float = 0.0


@dataclass(kw_only=True)
class StateMachine:
    """Remembers the mode and why it is that.

    Attributes:
        limits: Of what the robot may be seen to do.
        ages: Of the watchdogs.
        sleep_limit: After which the control process must not go on [s].
        mode: The present one.
        reason: Why.
        standing: Whether the ramp of STAND is over.
    """

    limits: Limits
    ages: Ages
    sleep_limit: float
    mode: Mode = Mode.DAMP
    reason: str = "not asked to stand yet"
    standing: bool = False
    _obeyed: int = field(default=0, repr=False)

    def update(self, watch: StateWatch, seen: Watched, request: Request, targets: np.ndarray | None) -> bool:
        """Decide; returns whether the mode has changed.

        Args:
            watch: The robot.
            seen: The processes.
            request: The operator's newest.
            targets: (29,) that the joints were last sent to [rad]; None while they are not held.
        """
        before = self.mode
        stuck = watch.stuck(targets)
        fatal = self._fatal(watch, seen, request, stuck)
        asked = request.mode if request.number != self._obeyed else None
        self._obeyed = request.number
        if fatal:
            if self.mode != Mode.DAMP or asked not in (None, Mode.DAMP) or request.estop:
                self._enter(Mode.DAMP, fatal)
        elif asked is not None:
            self._obey(asked, watch, seen)
        if self.mode in (Mode.RUN, Mode.STAND):
            held = self._held(watch, seen, stuck)
            if held:
                self._enter(Mode.HOLD if self.standing else Mode.DAMP, held)
        return self.mode != before

    def _obey(self, asked: Mode, watch: StateWatch, seen: Watched) -> None:
        if asked == Mode.DAMP:
            self._enter(asked, "operator")
        elif asked == Mode.STAND and self.mode == Mode.DAMP:
            missing = self._missing(watch, seen, with_policy=False)
            if missing:
                self.reason = f"will not stand: {missing}"
            else:
                self.standing = False
                self._enter(asked, "operator")
        elif asked == Mode.HOLD and self.mode in (Mode.RUN, Mode.STAND) and self.standing:
            self._enter(asked, "operator")
        elif asked == Mode.RUN and self.mode in (Mode.STAND, Mode.HOLD) and self.standing:
            missing = self._missing(watch, seen, with_policy=True)
            if missing:
                self.reason = f"will not run: {missing}"
            else:
                self._enter(asked, "operator")

    def _enter(self, mode: Mode, reason: str) -> None:
        if mode == Mode.DAMP:
            self.standing = False
        self.mode, self.reason = mode, reason

    def _fatal(self, watch: StateWatch, seen: Watched, request: Request, stuck: np.ndarray) -> str:
        """Return what leaves nothing but to damp; empty for nothing."""
        limits = self.limits
        if request.estop:
            return f"e-stop by {request.estop}"
        if seen.state > self.ages.state:
            return f"state lost for {seen.state:.3f} s; refused {watch.refused}"
        if watch.changed_machine():
            assert watch.state is not None
            return f"mode_machine {watch.state.mode_machine} after {watch.mode_machine}"
        if self.mode == Mode.DAMP:
            return ""
        if seen.slept > self.sleep_limit:
            return f"control slept for {seen.slept:.3f} s"
        if watch.tilt > limits.tilt:
            return f"fall: pelvis leans {watch.tilt:.2f} rad"
        fast = watch.too_fast()
        if fast.any():
            return f"too fast: {_named(fast)}"
        if watch.hottest()[0] > limits.hot:
            return "hot motor: {} Celsius in {}".format(*_warmest(watch))
        if watch.imu_error > limits.imu_error:
            return f"IMU: attitude and accelerometer differ by {watch.imu_error:.2f} rad"
        if stuck[: ARMS.start].any():
            return f"stuck encoder: {_named(stuck)}"
        return ""

    def _held(self, watch: StateWatch, seen: Watched, stuck: np.ndarray) -> str:
        """Return what leaves the robot its balance but not its work; empty for nothing."""
        if self.mode == Mode.RUN:
            for name, what in (("policy", "policy silent"), ("pose", "pose stale")):
                age = getattr(seen, name)
                if age > getattr(self.ages, name):
                    return f"{what} for {age:.3f} s"
        for name, what in (("servos", "servos"), ("operator", "operator"), ("recorder", "recorder")):
            age = getattr(seen, name)
            if age > getattr(self.ages, name):
                return f"{what} silent for {age:.3f} s"
        if failed := _failed(seen):
            return failed
        if watch.hottest()[0] > self.limits.warm:
            return "warm motor: {} Celsius in {}".format(*_warmest(watch))
        if stuck[ARMS].any():
            return f"stuck encoder: {_named(stuck)}"
        return ""

    def _missing(self, watch: StateWatch, seen: Watched, *, with_policy: bool) -> str:
        """Return what is not there yet."""
        names = ("servos", "operator", "recorder", *(("policy", "pose") if with_policy else ()))
        absent = [name for name in names if getattr(seen, name) > getattr(self.ages, name)]
        if watch.tilt > 0.5 * self.limits.tilt:
            return f"pelvis leans {watch.tilt:.2f} rad"
        if absent:
            return f"no {', '.join(absent)}"
        if with_policy and seen.unseen:
            return f"not seen yet: {seen.unseen}"
        return _failed(seen) or ("" if with_policy else self._unfit(watch))

    def _unfit(self, watch: StateWatch) -> str:
        """Return why this is no robot that can stand up; empty where it is one."""
        if watch.mode_machine != MODE_MACHINE_29:
            return f"mode_machine {watch.mode_machine}, not {MODE_MACHINE_29}, a G1 with 29 joints"
        outside = watch.outside()
        return f"outside its range: {_named(outside)}" if outside.any() else ""


def _failed(seen: Watched) -> str:
    """Return which process says that it cannot do its work, and why; empty for none."""
    if seen.recorder_failed:
        return f"recorder: {seen.recorder_failed}"
    return f"servos: {seen.servos_failed}" if seen.servos_failed else ""


def _named(joints: np.ndarray) -> str:
    return ", ".join(name for name, marked in zip(g1.BODY_JOINTS, joints, strict=True) if marked)


def _warmest(watch: StateWatch) -> tuple[float, str]:
    degrees, joint = watch.hottest()
    return degrees, g1.BODY_JOINTS[joint]
