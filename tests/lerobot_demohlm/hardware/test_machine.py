"""DAMP, STAND, RUN, HOLD: which answer each loss gets, and who may lift it."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowState
from lerobot_demohlm.hardware.limits import Ages, Limits
from lerobot_demohlm.hardware.machine import Request, StateMachine, Watched
from lerobot_demohlm.hardware.records import Mode
from lerobot_demohlm.hardware.state_watch import StateWatch

WELL = Watched(state=0.001, policy=0.05, pose=0.02, servos=0.02, operator=0.02, recorder=0.01)


class Robot:
    """A machine with a robot whose state can be spoiled."""

    def __init__(self) -> None:
        self.machine = StateMachine(limits=Limits(), ages=Ages(), sleep_limit=0.05)
        self.watch, self.tick, self.number = StateWatch(Limits()), 0, 0
        self.tell()

    def tell(self, **changes: object) -> None:
        self.tick += 1
        told = LowState()
        told.quat_wxyz[0], told.accelerometer[2], told.mode_machine, told.tick = 1.0, 9.81, 5, self.tick
        told.q[:NUM_JOINTS] = 1e-4 * self.tick
        for name, value in changes.items():
            if isinstance(value, int):
                setattr(told, name, value)
            else:
                getattr(told, name)[...] = value
        told.seal()
        assert self.watch.take(told.to_bytes(), time.monotonic_ns())

    def ask(self, mode: Mode, seen: Watched = WELL, estop: str = "") -> Mode:
        self.number += 1
        self.machine.update(self.watch, seen, Request(mode=mode, number=self.number, estop=estop), None)
        return self.machine.mode

    def see(self, seen: Watched = WELL, estop: str = "") -> Mode:
        self.machine.update(self.watch, seen, Request(mode=Mode.RUN, number=self.number, estop=estop), None)
        return self.machine.mode

    def running(self) -> "Robot":
        assert self.ask(Mode.STAND) == Mode.STAND
        self.machine.standing = True
        assert self.ask(Mode.RUN) == Mode.RUN
        return self


@pytest.mark.parametrize(("name", "limit", "mode"), [
    ("state", 0.040, Mode.DAMP), ("policy", 0.300, Mode.HOLD), ("pose", 0.500, Mode.HOLD),
    ("servos", 0.500, Mode.HOLD), ("operator", 0.500, Mode.HOLD), ("recorder", 3.0, Mode.HOLD),
])  # fmt: skip
def test_each_age_has_its_limit_and_its_answer(name: str, limit: float, mode: Mode) -> None:
    robot = Robot().running()
    assert robot.see(replace(WELL, **{name: limit - 1e-4})) == Mode.RUN
    assert robot.see(replace(WELL, **{name: limit + 1e-4})) == mode
    assert name in robot.machine.reason
    assert robot.see() == mode, "it does not go on by itself"


@pytest.mark.parametrize("changes", [
    {"quat_wxyz": np.array([math.cos(0.5), math.sin(0.5), 0, 0])}, {"mode_machine": 6},
    {"temperature": np.int16(100)}, {"dq": np.float32(30.0)},
])  # fmt: skip
def test_what_cannot_be_survived_on_two_legs_damps(changes: dict[str, object]) -> None:
    robot = Robot().running()
    robot.tell(**changes)
    assert robot.see() == Mode.DAMP
    assert robot.machine.reason != "operator"
    assert robot.see() == Mode.DAMP


def test_it_does_not_run_before_what_it_needs_was_seen_and_runs_on_where_that_is_lost() -> None:
    robot, unseen = Robot(), replace(WELL, unseen="box")
    assert robot.ask(Mode.STAND, unseen) == Mode.STAND
    robot.machine.standing = True
    assert robot.ask(Mode.RUN, unseen) == Mode.STAND and robot.machine.reason == "will not run: not seen yet: box"
    assert robot.ask(Mode.RUN) == Mode.RUN and robot.see(unseen) == Mode.RUN


def test_a_control_process_that_slept_must_not_go_on() -> None:
    robot = Robot().running()
    assert robot.see(replace(WELL, slept=0.06)) == Mode.DAMP
    assert "slept" in robot.machine.reason


def test_an_estop_stays_until_it_is_lifted() -> None:
    robot = Robot().running()
    assert robot.see(estop="remote") == Mode.DAMP
    assert robot.machine.reason == "e-stop by remote"
    assert robot.ask(Mode.STAND, estop="remote") == Mode.DAMP
    assert robot.ask(Mode.RUN) == Mode.DAMP
    assert robot.ask(Mode.STAND) == Mode.STAND


def test_a_warm_motor_holds_and_a_full_disk_too() -> None:
    robot = Robot().running()
    robot.tell(temperature=np.int16(90))
    assert robot.see() == Mode.HOLD and "warm motor" in robot.machine.reason
    robot = Robot().running()
    assert robot.see(replace(WELL, recorder_failed="No space left on device")) == Mode.HOLD
    assert robot.machine.reason == "recorder: No space left on device"


def test_servos_that_do_not_hold_hold_the_robot_and_keep_it_from_standing() -> None:
    failed = replace(WELL, servos_failed="servo 2 has stopped: overload")
    robot = Robot().running()
    assert robot.see(failed) == Mode.HOLD and robot.machine.reason == "servos: servo 2 has stopped: overload"
    robot = Robot()
    assert robot.ask(Mode.STAND, failed) == Mode.DAMP and robot.machine.reason.startswith("will not stand: servos: ")


def test_an_estop_that_is_pressed_in_damp_is_shown() -> None:
    robot = Robot()
    assert robot.see(estop="gamepad") == Mode.DAMP and robot.machine.reason == "e-stop by gamepad"
    assert robot.see() == Mode.DAMP and robot.machine.reason == "e-stop by gamepad"


@pytest.mark.parametrize(("changes", "reason"), [
    ({"mode_machine": 6}, "mode_machine 6, not 5"), ({"q": np.float32(3.0)}, "outside its range: left_hip_pitch"),
])  # fmt: skip
def test_another_kind_of_robot_does_not_stand(changes: dict[str, object], reason: str) -> None:
    robot = Robot()
    robot.watch = StateWatch(Limits())
    robot.tell(**changes)
    assert robot.ask(Mode.STAND) == Mode.DAMP
    assert robot.machine.reason.startswith(f"will not stand: {reason}")


def test_only_the_operator_leads_out_of_hold_and_damp() -> None:
    robot = Robot().running()
    assert robot.ask(Mode.HOLD) == Mode.HOLD and robot.see() == Mode.HOLD
    assert robot.ask(Mode.RUN) == Mode.RUN
    assert robot.ask(Mode.DAMP) == Mode.DAMP
    assert robot.ask(Mode.RUN) == Mode.DAMP and robot.ask(Mode.HOLD) == Mode.DAMP
    assert robot.ask(Mode.STAND) == Mode.STAND
    assert robot.ask(Mode.RUN) == Mode.STAND, "not before the ramp is over"


def test_it_does_not_stand_or_run_while_something_is_missing() -> None:
    robot = Robot()
    assert robot.ask(Mode.STAND, replace(WELL, servos=math.inf)) == Mode.DAMP
    assert robot.machine.reason == "will not stand: no servos"
    robot.ask(Mode.STAND)
    robot.machine.standing = True
    assert robot.ask(Mode.RUN, replace(WELL, policy=math.inf, pose=math.inf)) == Mode.STAND
    assert robot.machine.reason == "will not run: no policy, pose"


def test_a_loss_during_the_ramp_damps() -> None:
    robot = Robot()
    robot.ask(Mode.STAND)
    assert robot.see(replace(WELL, operator=1.0)) == Mode.DAMP


def test_before_the_first_state_nothing_stands() -> None:
    robot = Robot()
    robot.watch = StateWatch(Limits())
    assert robot.ask(Mode.STAND, replace(WELL, state=math.inf)) == Mode.DAMP
    assert "state lost" in robot.machine.reason
