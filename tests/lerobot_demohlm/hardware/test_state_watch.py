"""Which LowStates are believed, and what is odd about a robot."""

import math

import numpy as np
import pytest

from lerobot_demohlm.hardware.faults import Fault, Faults, FaultyLine, FaultySensors
from lerobot_demohlm.hardware.layout import NUM_JOINTS, LowState
from lerobot_demohlm.hardware.limits import Limits
from lerobot_demohlm.hardware.remote import BUTTONS, asks_to_stop, buttons, press, pressed
from lerobot_demohlm.hardware.state_watch import StateWatch

STEP_NS = 2_000_000


def state(tick: int, *, noise: float = 1e-4) -> LowState:
    made = LowState()
    made.quat_wxyz[0], made.accelerometer[2], made.mode_machine, made.tick = 1.0, 9.81, 5, tick
    made.q[:NUM_JOINTS] = noise * np.random.default_rng(tick).standard_normal(NUM_JOINTS)
    made.temperature[:NUM_JOINTS] = 35
    made.seal()
    return made


def fed(fault: Fault | None = None, count: int = 1000) -> StateWatch:
    """Return what has seen a robot for a while (2 s), with a fault from the half on."""
    watch, sensors = StateWatch(Limits()), FaultySensors(Faults(faults=() if fault is None else (fault,)))
    for tick in range(1, count):
        told = state(tick)
        sensors.spoil(told, 0.002 * tick, 0.002)
        told.seal()
        watch.take(told.to_bytes(), tick * STEP_NS)
    return watch


def test_a_sound_robot_is_believed() -> None:
    watch = fed()
    assert watch.refused == {"crc": 0, "numbers": 0, "tick": 0}
    assert watch.time_ns == 999 * STEP_NS and watch.tilt == 0.0 and watch.imu_error < 1e-6
    assert not watch.stuck(np.ones(NUM_JOINTS)).any() and not watch.too_fast().any() and not watch.changed_machine()


@pytest.mark.parametrize(("kind", "why"), [("frozen_tick", "tick"), ("nan", "numbers")])
def test_what_says_nothing_grows_old(kind: str, why: str) -> None:
    watch = fed(Fault(kind=kind, at_s=1.0))
    assert watch.refused[why] >= 498 and watch.time_ns <= 500 * STEP_NS


def test_a_flipped_bit_is_refused_and_so_is_an_older_message() -> None:
    watch = fed(count=10)
    damaged = bytearray(state(10).to_bytes())
    damaged[100] ^= 4
    assert not watch.take(bytes(damaged)) and watch.refused["crc"] == 1
    assert not watch.take(b"short") and watch.refused["crc"] == 2
    assert not watch.take(state(5).to_bytes()) and not watch.take(state(9).to_bytes())
    assert watch.refused["tick"] == 2
    assert watch.take(state(10).to_bytes())


def test_a_counter_that_wraps_goes_on() -> None:
    watch = StateWatch(Limits())
    assert all(watch.take(state(tick).to_bytes()) for tick in (2**32 - 2, 2**32 - 1, 0, 1))


def test_a_counter_that_begins_again_is_another_robot_while_motors_hold() -> None:
    watch = StateWatch(Limits())
    assert watch.take(state(500_000).to_bytes())
    for other in (1, 2_000_000):
        assert not watch.take(state(other).to_bytes(), may_restart=False)
    assert watch.take(state(500_020).to_bytes(), may_restart=False)
    assert watch.take(state(1).to_bytes())


def test_a_stuck_encoder_is_found_where_its_joint_should_move() -> None:
    watch = fed(Fault(kind="stuck_encoder", at_s=1.0, joint="left_knee"))
    knee = Fault(kind="stuck_encoder", at_s=0.0, joint="left_knee").index
    assert np.flatnonzero(watch.stuck(np.full(NUM_JOINTS, 0.5))).tolist() == [knee]
    assert not watch.stuck(np.zeros(NUM_JOINTS)).any()


def test_a_drifting_attitude_parts_from_the_accelerometer() -> None:
    watch = fed(Fault(kind="imu_drift", at_s=0.5, size=0.6), count=1500)
    assert watch.imu_error > Limits().imu_error
    assert watch.tilt == pytest.approx(0.6 * 2.5, abs=0.01)


def test_a_hot_motor_and_another_machine_are_seen() -> None:
    assert fed(Fault(kind="hot_motor", at_s=1.0, size=99.0)).hottest() == (99.0, 3)
    assert fed(Fault(kind="mode_machine", at_s=1.0)).changed_machine()


def test_the_line_loses_delays_and_doubles_by_seed() -> None:
    def carried(kind: str, size: float, seed: int = 0) -> list[int]:
        line = FaultyLine(Faults(seed=seed, faults=(Fault(kind=kind, at_s=0.0, size=size),)))
        messages = [(0.002 * tick, line.carry(state(tick).to_bytes(), 0.002 * tick)) for tick in range(1, 101)]
        return [LowState(content).tick for _, found in messages for content in found]

    assert carried("loss", 1.0) == []
    assert 30 < len(carried("loss", 0.5)) < 70
    assert carried("loss", 0.5) == carried("loss", 0.5) != carried("loss", 0.5, seed=1)
    assert carried("delay", 0.02) == list(range(1, 91))
    assert sorted(carried("duplicate", 1.0)) == sorted([*range(1, 101)] * 2)
    mixed = carried("reorder", 0.4)
    assert mixed != sorted(mixed) and len(set(mixed)) >= 99
    line = FaultyLine(Faults(faults=(Fault(kind="bad_crc", at_s=0.0),)))
    assert not LowState(line.carry(state(1).to_bytes(), 0.1)[0]).is_sound()


def test_buttons_of_the_remote() -> None:
    bytes_of_remote = np.zeros(40, np.uint8)
    for name in BUTTONS:
        press(bytes_of_remote, frozenset({name}))
        assert pressed(buttons(bytes_of_remote)) == {name}
        assert asks_to_stop(buttons(bytes_of_remote)) == (name == "select")
    press(bytes_of_remote, frozenset({"L2", "B", "up"}))
    assert asks_to_stop(buttons(bytes_of_remote))
    assert bytes_of_remote[2] == 1 << 5 and bytes_of_remote[3] == (1 << 1) + (1 << 4)  # Unitree's order of bits


def test_tilt_is_that_of_the_pelvis() -> None:
    watch, told = StateWatch(Limits()), state(1)
    told.quat_wxyz[:] = math.cos(0.3), 0.0, math.sin(0.3), 0.0
    told.seal()
    watch.take(told.to_bytes())
    assert watch.tilt == pytest.approx(0.6, abs=1e-6)
