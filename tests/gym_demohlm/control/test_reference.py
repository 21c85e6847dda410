"""The walking reference: the same in a mirror, feet where they land without a tilt, a capture point over the soles."""

import numpy as np
import pytest

from gym_demohlm.control import features, gait_clock, odometry, reference
from gym_demohlm.control.settings import Gait
from gym_demohlm.control.whole_body import Weights
from gym_demohlm.robot import g1
from tests.helpers.gaits import GAITS

_WORLDS = 40


def _pose(gait: Gait) -> reference.Reference:
    pose = Weights().make_reference()
    pose.gait = gait
    return pose


def _situations(seed: int) -> tuple[np.ndarray, gait_clock.Clock, np.ndarray, np.ndarray, np.ndarray]:
    """Return commands (N, 7), clocks, velocities (N, 2), moments (N, 2) and attitudes (N, 4) of robots that walk."""
    rng = np.random.default_rng(seed)
    commands = rng.uniform([-0.5, -0.4, -1, 0.62, 0, -0.2, -0.3], [0.8, 0.4, 1, 0.76, 0, 0.3, 0.3], (_WORLDS, 7))
    standing = rng.random(_WORLDS) < 0.2
    clock = gait_clock.Clock(
        rng.random(_WORLDS), rng.uniform(0, 1, _WORLDS) * (rng.random(_WORLDS) < 0.5), standing, rng.random(_WORLDS)
    )
    return commands, clock, *(rng.normal(0, 0.1, (_WORLDS, size)) for size in (2, 2, 4))


@pytest.mark.parametrize("gait", GAITS.values(), ids=GAITS.keys())
def test_a_walk_is_the_same_in_a_mirror(gait: Gait) -> None:
    commands, clock, velocity, moment, attitude = _situations(0)
    source, sign = features.COMMAND_MIRROR
    other = clock._replace(phase=(clock.phase + 0.5) % 1.0)
    pose = _pose(gait)
    plain = pose.pose(commands, clock, velocity, moment, attitude)
    mirrored = pose.pose(
        commands[:, source] * sign, other, velocity * [1, -1], moment * [1, -1], attitude * [1, -1, 1, -1]
    )
    np.testing.assert_allclose(features.mirror(mirrored, features.ACTION_MIRROR), plain, atol=1e-9)


def test_a_gait_of_today_takes_no_notice_of_the_attitude() -> None:
    commands, clock, velocity, moment, attitude = _situations(1)
    pose = _pose(Gait())
    assert np.array_equal(
        pose.pose(commands, clock, velocity, moment, attitude), pose.pose(commands, clock, velocity, moment)
    )


def test_a_swinging_foot_lands_where_it_would_without_a_tilt() -> None:
    """With the whole tilt made up for, the foot at the end of its swing is where it was planned, seen upright."""
    commands, _, velocity, moment, _ = _situations(2)
    clock = gait_clock.Clock(
        np.full(_WORLDS, 0.4 - 1e-9), np.zeros(_WORLDS), np.zeros(_WORLDS, dtype=bool), np.zeros(_WORLDS)
    )
    pose = _pose(Gait(swing_upright=1.0))
    footing = pose.footing(commands, moment)
    off = np.random.default_rng(3).uniform(-0.15, 0.15, (_WORLDS, 2))
    now = np.stack([footing.tilt, footing.bank], axis=1) + off
    places = []
    for attitude in (now - off, now):
        legs = pose.pose(commands, clock, velocity, moment, np.concatenate([attitude, 0 * off], axis=1))[:, :12]
        places.append(_in_heading(odometry.sole_points(legs)[:, 0], attitude))
    np.testing.assert_allclose(places[1], places[0], atol=0.004)  # m: a leg that is stretched out is shorter


def _in_heading(points: np.ndarray, attitude: np.ndarray) -> np.ndarray:
    """Turn points (N, 3) from a pelvis of some pitch and roll (N, 2) into its heading frame."""
    pitch, roll = attitude.T
    x, y, z = points.T
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    return np.stack([np.cos(pitch) * x + np.sin(pitch) * z, y, np.cos(pitch) * z - np.sin(pitch) * x], axis=1)


def test_feet_walk_as_far_apart_as_the_gait_says_and_stand_under_the_hips() -> None:
    commands = np.tile([0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0], (3, 1))
    clock = gait_clock.Clock(np.full(3, 0.45), np.array([0.0, 0.125, 0.0]), np.array([False, False, True]), np.zeros(3))
    zero = np.zeros((3, 2))
    legs = _pose(Gait(spread=0.08)).pose(commands, clock, zero, zero)[:, :12]
    left, right = np.moveaxis(odometry.sole_points(legs), 1, 0)
    np.testing.assert_allclose(
        (left - right)[:, 1], 2 * np.array([0.08, (0.08 + g1.HIP_SPREAD) / 2, g1.HIP_SPREAD]), atol=5e-3
    )


@pytest.mark.parametrize(("recovers", "beside"), [(1.0, 0.13), (0.5, 0.13), (0.25, 0.105), (0.0, 0.08)])
def test_feet_of_a_robot_that_recovers_walk_further_apart(recovers: float, beside: float) -> None:
    commands, zero = np.tile([0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0], (1, 1)), np.zeros((1, 2))
    clock = gait_clock.Clock(np.full(1, 0.45), np.zeros(1), np.array([False]), np.full(1, recovers))
    legs = _pose(Gait(spread=0.08, recovery_spread=0.13)).pose(commands, clock, zero, zero)[:, :12]
    left, right = np.moveaxis(odometry.sole_points(legs), 1, 0)
    np.testing.assert_allclose((left - right)[:, 1], 2 * beside, atol=5e-3)


@pytest.mark.parametrize(("phase", "side"), [(0.4 - 1e-9, 0), (0.9 - 1e-9, 1)], ids=["left", "right"])
def test_a_foot_lands_further_out_by_the_whole_of_its_placement_and_further_in_by_a_share(
    phase: float, side: int
) -> None:
    commands, zero = np.tile([0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0], (3, 1)), np.zeros((3, 2))
    clock = gait_clock.Clock(np.full(3, phase), np.zeros(3), np.zeros(3, dtype=bool), np.zeros(3))
    outward = 1.0 if side == 0 else -1.0
    velocity = np.stack([np.zeros(3), outward * np.array([0.0, 0.3, -0.3])], axis=1)
    legs = _pose(Gait(placement_s=0.2, inward=0.5)).pose(commands, clock, velocity, zero)[:, :12]
    landing = outward * odometry.sole_points(legs)[:, side, 1]
    np.testing.assert_allclose(landing - landing[0], [0.0, 0.06, -0.03], atol=2e-3)


def test_the_capture_point_of_a_robot_in_its_pose_is_its_weights_place() -> None:
    rng = np.random.default_rng(4)
    commands = np.zeros((_WORLDS, 7))
    commands[:, 3:] = rng.uniform([0.5, -0.3, -0.1, -0.8], [0.74, 0.3, 0.8, 0.8], (_WORLDS, 4))
    pose, zero = _pose(GAITS["every part of it"]), np.zeros((_WORLDS, 2))
    legs = pose.pose(commands, gait_clock.at_rest(_WORLDS), zero, zero)[:, :12]
    footing = pose.footing(commands, zero)
    tilt = np.stack([footing.tilt, footing.bank], axis=1)
    soles = np.mean([_in_heading(odometry.sole_points(legs)[:, side], tilt) for side in (0, 1)], axis=0)
    at_rest = pose.capture(commands, zero, -soles[:, :2], zero)
    np.testing.assert_allclose(at_rest, 0.0, atol=0.003)
    speed = np.tile([0.5, 0.0], (_WORLDS, 1))
    further = pose.capture(commands, zero, -soles[:, :2], speed) - at_rest
    np.testing.assert_allclose(further[:, 0], 0.5 * np.sqrt(commands[:, 3] / 9.81))
    np.testing.assert_allclose(further[:, 1], 0.0, atol=1e-12)


def test_only_a_capture_point_outside_the_margins_asks_for_a_step() -> None:
    margins = (0.09, 0.08, 0.13)
    inside = np.array([[0.08, 0.0], [-0.07, 0.12], [0.0, -0.12]])
    outside = np.array([[0.1, 0.0], [-0.09, 0.0], [0.0, 0.14], [0.0, -0.14]])
    assert not gait_clock.escapes(inside, margins, np.zeros(3)).any()
    assert gait_clock.escapes(outside, margins, np.zeros(4)).all()
    assert gait_clock.escapes(inside, margins, np.full(3, 0.3)).all()  # tipping over a sole
