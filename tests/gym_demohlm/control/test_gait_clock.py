"""The gait clock: what makes a robot step, when it rests again, and how a push changes its steps for a while."""

import numpy as np
import pytest

from gym_demohlm.control import gait_clock
from gym_demohlm.control.settings import Gait
from gym_demohlm.errors import SceneError
from gym_demohlm.timing import CONTROL_DT


def test_clock_rests_when_the_command_stops_and_starts_again() -> None:
    clock = gait_clock.Clock(np.array([0.2]), np.array([0.0]), np.array([False]), np.zeros(1))
    still, calm = np.zeros((1, 3)), np.array([False])
    ticks = 0
    while not clock.standing[0]:
        clock = gait_clock.advance_clock(clock, still, calm, calm)
        ticks += 1
        assert ticks < 100
    assert ticks * CONTROL_DT >= gait_clock.STEPS_TO_SQUARE_UP * gait_clock.GAIT.period_s
    assert clock.phase[0] in gait_clock.REST_PHASES
    rested = clock
    clock = gait_clock.advance_clock(clock, still, calm, calm)
    assert clock.standing[0] and clock.phase[0] == rested.phase[0]
    clock = gait_clock.advance_clock(clock, np.array([[0.3, 0, 0]]), calm, calm)
    assert not clock.standing[0] and clock.phase[0] != rested.phase[0]


def test_a_robot_that_loses_balance_takes_steps_and_then_rests() -> None:
    clock = gait_clock.Clock(np.array([0.45, 0.45]), np.array([2.0, 2.0]), np.array([True, True]), np.zeros(2))
    still, calm = np.zeros((2, 3)), np.zeros(2, dtype=bool)
    startled = gait_clock.startled(np.array([[0.0, 0.1], [0.4, 0.0]]), np.zeros(2))
    assert startled.tolist() == [False, True]
    clock = gait_clock.advance_clock(clock, still, startled, calm)
    assert clock.standing.tolist() == [True, False]
    for _ in range(100):
        clock = gait_clock.advance_clock(clock, still, calm, calm)
    assert clock.standing.all()


def test_a_pushed_robot_steps_faster_and_then_as_before() -> None:
    gait = Gait(recovery_s=1.0, recovery_speed=0.3, recovery_spread=0.13, recovery_period_s=0.5)
    command = np.tile([0.2, 0.0, 0.0, 0.74, 0.0, 0.0, 0.0], (3, 1))
    pushed = gait_clock.pushed(np.array([[0.2, 0.0], [0.2, 0.35], [0.5, 0.0]]), command, gait)
    assert pushed.tolist() == [False, True, False]  # a robot is late along its way after every command
    clock = gait_clock.Clock(np.full(3, 0.2), np.zeros(3), np.zeros(3, dtype=bool), np.zeros(3))
    calm = np.zeros(3, dtype=bool)
    clock = gait_clock.advance_clock(clock, command[:, :3], calm, pushed, gait)
    assert gait_clock.period(clock.recovers, gait).tolist() == [0.64, 0.5, 0.64]
    np.testing.assert_allclose(clock.phase - 0.2, CONTROL_DT / np.array([0.64, 0.5, 0.64]))
    for _ in range(round(1.0 / CONTROL_DT) + 1):
        clock = gait_clock.advance_clock(clock, command[:, :3], calm, calm, gait)
    assert clock.recovers.tolist() == [0.0] * 3 and gait_clock.period(clock.recovers, gait).tolist() == [0.64] * 3


@pytest.mark.parametrize(
    "wrong",
    [{"recovery_period_s": 0.0}, {"recovery_s": -1.0}, {"recovery_speed": 0.0}, {"recovery_s": float("nan")}],
    ids=str,
)
def test_a_recovery_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SceneError, match=r"recovery.*; expected (0 or more|a finite number).*check the file"):
        Gait(**wrong)
