"""Waypoints become smooth hand paths; phases follow one another; operators watch what sags, is late, or swings."""

from dataclasses import replace

import numpy as np
import pytest

from gym_demohlm import poses
from lerobot_demohlm.teleop.operator import SceneView
from lerobot_demohlm.teleop.path import (
    MAX_SETTLING_TICKS,
    MAX_SHIFT_M,
    SETTLED_M,
    SETTLED_TICKS,
    HandPath,
    PathOperator,
    Waypoint,
)

SAG = np.array([0.0, 0.0, -0.012])  # m


def hands(z: float) -> np.ndarray:
    return np.stack([poses.pose([0.3, 0.2, z]), poses.pose([0.3, -0.2, z])])


def view(T_world_hands: np.ndarray) -> SceneView:
    eye = np.eye(4)
    return SceneView(tick=0, T_world_head=eye, T_world_pelvis=eye, T_world_hands=T_world_hands, T_world_objects={})


def test_a_path_ends_at_its_waypoints_with_each_hand_s_gripper() -> None:
    path = HandPath(
        hands(0.5),
        [
            Waypoint(T_world_hands=hands(0.8), duration_s=1.0, grippers=(0.0, 1.0)),
            Waypoint(T_world_hands=hands(0.6), duration_s=0.5, grippers=1.0),
        ],
    )
    assert len(path) == 15
    np.testing.assert_allclose(path.T_world_hands[[9, 14]], [hands(0.8), hands(0.6)])
    np.testing.assert_array_equal(path.grippers, [[0.0, 1.0]] * 10 + [[1.0, 1.0]] * 5)
    steps = np.abs(np.diff(path.T_world_hands[:, 0, 2, 3]))
    assert steps[:9].max() < 2.0 * 0.3 / 10  # minimum jerk: 1.875 times the mean speed
    assert steps[10:].max() < 2.0 * 0.2 / 5


def test_phases_are_planned_when_they_begin_and_go_on_where_the_last_ended() -> None:
    seen = []

    def plan(z: float) -> object:
        def phase(now: SceneView) -> list[Waypoint]:
            seen.append(float(now.T_world_hands[0, 2, 3]))
            return [Waypoint(T_world_hands=hands(z), duration_s=0.5)]

        return phase

    operator = PathOperator("two phases", [plan(0.8), plan(0.6)])  # pyright: ignore[reportArgumentType]
    asked = []
    measured = hands(0.5)
    while (now := operator.poses(view(measured))) is not None:
        asked.append(now.T_world_hands[0, 2, 3])
        measured = now.T_world_hands + 0.0
    assert seen == [0.5, pytest.approx(0.8)]
    assert len(asked) == 10
    assert asked[4] == pytest.approx(0.8) and asked[9] == pytest.approx(0.6)
    assert max(np.abs(np.diff(asked))) < 0.2


@pytest.mark.parametrize(("watched", "left"), [(True, 0.002), (False, 0.012)])
def test_a_watching_operator_makes_up_for_sagging_arms(watched: bool, left: float) -> None:
    still = [Waypoint(T_world_hands=hands(0.7), duration_s=2.5, watched=watched)]
    operator = PathOperator("holds still", [lambda _: still])
    measured = hands(0.7)
    while (now := operator.poses(view(measured))) is not None:
        measured = now.T_world_hands.copy()
        measured[:, :3, 3] += SAG
    np.testing.assert_allclose(measured[:, 2, 3], 0.7, atol=left + 1e-9)
    assert (measured[:, 2, 3] < 0.7 - 1e-5).all()


@pytest.mark.parametrize("shown", [True, False])
def test_an_operator_who_sees_its_targets_takes_none_that_is_late_for_a_miss(shown: bool) -> None:
    """Targets come 0.3 s late and palms are where they are; without the targets it would lead them too far."""
    way = [Waypoint(T_world_hands=hands(0.8), duration_s=1.2, watched=True)]
    operator = PathOperator("late", [lambda _: way])
    asked = [hands(0.5)] * 3
    while True:
        seen = view(asked[-3])
        now = operator.poses(replace(seen, T_world_targets=asked[-3]) if shown else seen)
        if now is None:
            break
        asked.append(now.T_world_hands)
    too_far = asked[-1][:, 2, 3] - 0.8
    assert (np.abs(too_far) < 1e-9).all() if shown else (too_far > 0.012).all()


def test_an_operator_who_sees_its_targets_still_makes_up_for_sagging_arms() -> None:
    still = [Waypoint(T_world_hands=hands(0.7), duration_s=2.5, watched=True)]
    operator = PathOperator("holds still", [lambda _: still])
    measured = targets = hands(0.7)
    while (now := operator.poses(replace(view(measured), T_world_targets=targets))) is not None:
        targets, measured = now.T_world_hands, now.T_world_hands.copy()
        measured[:, :3, 3] += SAG
    np.testing.assert_allclose(measured[:, 2, 3], 0.7, atol=0.002)


def test_what_cannot_be_reached_is_not_chased() -> None:
    still = [Waypoint(T_world_hands=hands(0.7), duration_s=10.0, watched=True)]
    operator = PathOperator("pushes a wall", [lambda _: still])
    asked = hands(0.7)
    while (now := operator.poses(view(hands(0.5)))) is not None:
        asked = now.T_world_hands
    np.testing.assert_allclose(asked[:, 2, 3], 0.7 + MAX_SHIFT_M)


def grip(settled: bool) -> PathOperator:
    """Return an operator that goes 0.3 m down in 1.2 s, and then closes its grippers for 0.5 s."""
    way = [
        Waypoint(T_world_hands=hands(0.5), duration_s=1.2),
        Waypoint(T_world_hands=hands(0.5), duration_s=0.5, grippers=1.0, settled=settled),
    ]
    return PathOperator("grips", [lambda _: way])


def swinging(operator: PathOperator) -> tuple[np.ndarray, np.ndarray]:
    """Return heights (T,) [m] of a target that swings after what is asked, and grippers (T,), until it is over."""
    z, speed, heights, grippers = 0.8, 0.0, [], []
    while (now := operator.poses(replace(view(hands(z)), T_world_targets=hands(z)))) is not None:
        heights.append(z)
        grippers.append(now.grippers[0])
        for _ in range(10):
            speed += 0.01 * (64.0 * (now.T_world_hands[0, 2, 3] - z) - 2.0 * 0.5 * 8.0 * speed)
            z += 0.01 * speed
    return np.array(heights), np.array(grippers)


def test_a_gripper_closes_once_a_target_that_swings_has_settled() -> None:
    heights, grippers = swinging(grip(settled=True))
    assert heights.min() < 0.5 - SETTLED_M  # it swings past the goal
    closes = int(np.argmax(grippers > 0.5))
    assert np.abs(heights[closes + 1 - SETTLED_TICKS :] - 0.5).max() <= SETTLED_M
    assert grippers.sum() == 5
    heights, grippers = swinging(grip(settled=False))
    assert np.abs(heights[np.argmax(grippers > 0.5)] - 0.5) > SETTLED_M


@pytest.mark.parametrize("shown", [True, False])
def test_an_operator_who_waits_keeps_its_path_where_there_is_nothing_to_wait_for(shown: bool) -> None:
    """Palms follow at once; where targets are shown, they are there: it only looks for 0.3 s."""
    asked = {}
    for settled in (True, False):
        operator, measured, found = grip(settled), hands(0.8), []
        while (now := operator.poses(replace(view(measured), T_world_targets=measured if shown else None))) is not None:
            measured = now.T_world_hands
            found.append(np.append(measured.ravel(), now.grippers))
        asked[settled] = np.stack(found)
    waited = SETTLED_TICKS - 1 if shown else 0
    np.testing.assert_array_equal(np.delete(asked[True], range(12, 12 + waited), axis=0), asked[False])


def test_a_target_that_never_comes_is_not_waited_for_for_ever() -> None:
    operator, ticks = grip(settled=True), 0
    while operator.poses(replace(view(hands(0.8)), T_world_targets=hands(0.8))) is not None:
        ticks += 1
    assert ticks == 12 + MAX_SETTLING_TICKS + 5
