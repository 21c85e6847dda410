"""A base that left its place is led back; one that stands, sways or moves as demonstrated is let be."""

import math

import numpy as np
import pytest

from gym_demohlm import poses
from lerobot_demohlm.generation.stance import Stance

LEAVE_M = 0.1
THERE = poses.planar(0.4, -0.3, 0.7)


def velocities(stance: Stance, way: np.ndarray, demonstrated: np.ndarray | None = None) -> np.ndarray:
    """Return the velocities (T, 3) for bases that are moved by (T, 3) in their own frame."""
    demonstrated = np.zeros_like(way) if demonstrated is None else demonstrated
    return np.array(
        [
            stance.velocity(THERE @ poses.planar(*moved), poses.planar(*shown), LEAVE_M)
            for moved, shown in zip(way, demonstrated, strict=True)
        ]
    )


def creep(distance: float, axis: int, ticks: int = 40) -> np.ndarray:
    way = np.zeros((ticks, 3))
    way[:, axis] = np.linspace(0.0, distance, ticks)
    return way


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_base_that_creeps_away_is_led_back(axis: int, sign: int) -> None:
    found = velocities(Stance(7), creep(sign * (0.4 if axis == 2 else 0.2), axis))
    assert not found[:15].any()
    assert np.sign(found[-1, axis]) == -sign
    others = np.delete(found[-1], axis)
    assert np.abs(others).max() < 0.05


def test_it_stands_again_once_it_is_back() -> None:
    away = creep(-0.2, 0)
    found = velocities(Stance(7), np.concatenate([away, away[::-1], np.zeros((10, 3))]))
    assert found.any(axis=1).sum() > 10
    assert not found[-10:].any()


def test_a_base_that_sways_or_bends_as_demonstrated_is_let_be() -> None:
    sway = 0.06 * np.sin(np.arange(60))[:, None] * [0.0, 1.0, 0.0]
    assert not velocities(Stance(7), sway).any()
    bent = creep(-0.15, 0)
    assert not velocities(Stance(7), bent, bent).any()


def test_what_leaves_its_place_on_purpose_stays_where_it_comes_to_stand() -> None:
    stance = Stance(7)
    velocities(stance, creep(0.05, 0))
    stance.leave()
    elsewhere = np.tile([1.0, 0.5, 0.2], (20, 1))
    assert not velocities(stance, elsewhere).any()


def test_it_does_not_step_where_it_must_not() -> None:
    stance = Stance(7)
    assert velocities(stance, creep(-0.2, 0))[-1].any()
    assert not stance.velocity(THERE @ poses.planar(-0.2, 0.0, 0.0), np.eye(4), math.inf).any()
    assert not stance.steps


@pytest.mark.parametrize("drift_gain", [0.0, 0.6])
def test_a_base_that_drifts_against_its_steps_comes_back_if_its_errors_add_up(drift_gain: float) -> None:
    stance, base, stood = Stance(7, drift_gain), 0.0, []
    for _ in range(200):
        velocity = stance.velocity(THERE @ poses.planar(base, 0.0, 0.0), np.eye(4), LEAVE_M)
        stood.append(not stance.steps)
        base += 0.1 * (velocity[0] - 0.12 if stance.steps else -0.03)
    arrived = bool(np.diff(np.array(stood, dtype=int)).max() > 0)
    assert arrived == (drift_gain > 0.0)
