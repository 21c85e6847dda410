"""The clutch: relative motion, headings, scale, holding, re-engaging, lost tracking, silence, sticks and grippers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_demohlm import poses
from lerobot_demohlm.teleop.clutch import LEASH_M, SETTLING_STEPS, SILENCE_S, Clutch, Controls, HandControls
from lerobot_demohlm.teleop.operator import SceneView

ANGLES = st.floats(-math.pi, math.pi)
STEP = np.array([0.03, -0.02, 0.05])  # m, less than a glitch


def view(base: np.ndarray | None = None) -> SceneView:
    base = np.eye(4) if base is None else base
    hands = np.stack([poses.pose([0.3, y, 0.8]) for y in (0.2, -0.2)])
    return SceneView(
        tick=0,
        T_world_head=base @ poses.pose([0.05, 0.0, 1.2]),
        T_world_pelvis=base @ poses.pose([0.0, 0.0, 0.75]),
        T_world_hands=base @ hands,
        T_world_objects={},
    )


def right(pose: np.ndarray | None, engaged: bool = True, grip: float = 0.0, **rest: object) -> Controls:
    return Controls(right=HandControls(pose=pose, engaged=engaged, grip=grip), **rest)  # type: ignore[arg-type]


@given(operator=ANGLES, robot=ANGLES, device=ANGLES, scale=st.floats(0.3, 2.0))
def test_motion_counts_in_the_operators_heading_and_is_scaled(
    operator: float, robot: float, device: float, scale: float
) -> None:
    base = poses.planar(0.4, -0.3, robot)
    room = poses.planar(3.0, 1.0, operator)  # where the operator stands, however the room is turned
    clutch = Clutch(scale)
    before = poses.from_rotation(poses.rotation_from_rpy([device, 0.3, 0.2]), [0.3, 0.1, 1.0])
    after = before.copy()
    after[:3, 3] += STEP
    head = room @ poses.pose([0.0, 0.0, 1.6])
    clutch.poses(right(room @ before, head=head), view(base))
    asked = clutch.poses(right(room @ after, head=head), view(base))
    moved = asked.T_world_hands[1, :3, 3] - view(base).T_world_hands[1, :3, 3]
    np.testing.assert_allclose(moved, scale * base[:3, :3] @ STEP, atol=1e-9)
    np.testing.assert_allclose(asked.T_world_hands[1, :3, :3], view(base).T_world_hands[1, :3, :3], atol=1e-9)


@given(drawn=ANGLES, robot=ANGLES, looks=st.tuples(ANGLES, ANGLES))
def test_where_the_robot_is_drawn_motion_counts_as_it_is_seen_wherever_one_looks(
    drawn: float, robot: float, looks: tuple[float, float]
) -> None:
    base, room = poses.planar(0.0, 0.0, robot), poses.planar(0.0, 0.0, drawn)
    clutch, held = Clutch(), poses.pose([0.3, 0.1, 1.0])
    hands = [HandControls(), HandControls()]
    for index, look in enumerate(looks):  # one hand is taken after the other, while the operator looks around
        head = poses.planar(0.0, 0.0, look) @ poses.pose([0.0, 0.0, 1.6])
        hands[index] = HandControls(pose=held, engaged=True)
        clutch.poses(Controls(left=hands[0], right=hands[1], head=head, heading=drawn), view(base))
    after = held.copy()
    after[:3, 3] += room[:3, :3] @ STEP
    moved = HandControls(pose=after, engaged=True)
    asked = clutch.poses(Controls(left=moved, right=moved, head=head, heading=drawn), view(base))
    motions = asked.T_world_hands[:, :3, 3] - view(base).T_world_hands[:, :3, 3]
    np.testing.assert_allclose(motions, np.stack([base[:3, :3] @ STEP] * 2), atol=1e-9)


@given(operator=ANGLES, robot=ANGLES, turn=st.floats(-1.0, 1.0))
def test_turns_are_made_about_the_operators_axes(operator: float, robot: float, turn: float) -> None:
    base, room = poses.planar(0.0, 0.0, robot), poses.planar(0.0, 0.0, operator)
    clutch = Clutch()
    start = poses.pose([0.3, 0.0, 1.0])
    turned = poses.from_rotation(poses.rotation_from_rpy([0.0, turn, 0.0]), [0.3, 0.0, 1.0])
    head = room @ poses.pose([0.0, 0.0, 1.6])
    clutch.poses(right(room @ start, head=head), view(base))
    asked = clutch.poses(right(room @ turned, head=head), view(base))
    expected = base[:3, :3] @ poses.rotation_from_rpy([0.0, turn, 0.0])
    np.testing.assert_allclose(asked.T_world_hands[1, :3, :3], expected, atol=1e-9)


def test_engaging_again_does_not_jump_and_letting_go_holds() -> None:
    clutch = Clutch()
    clutch.poses(right(poses.pose([0.0, 0.0, 1.0])), view())
    first = clutch.poses(right(poses.pose(STEP + np.array([0.0, 0.0, 1.0]))), view())
    released = clutch.poses(right(poses.pose([0.9, 0.9, 0.2]), engaged=False), view())
    again = clutch.poses(right(poses.pose([-0.5, 0.7, 1.9])), view())
    np.testing.assert_array_equal(released.T_world_hands, first.T_world_hands)
    np.testing.assert_array_equal(again.T_world_hands, first.T_world_hands)
    onward = clutch.poses(right(poses.pose(STEP + np.array([-0.5, 0.7, 1.9]))), view())
    np.testing.assert_allclose(onward.T_world_hands[1, :3, 3], first.T_world_hands[1, :3, 3] + STEP, atol=1e-12)


@pytest.mark.parametrize("back", [np.zeros(3), np.array([0.6, 0.0, 0.0])], ids=["lost", "glitch"])
def test_lost_tracking_holds_and_tracking_that_jumps_does_not_move_the_hand(back: np.ndarray) -> None:
    clutch = Clutch()
    place = np.array([0.0, 0.0, 1.0])
    start = clutch.poses(right(poses.pose(place)), view())
    if not back.any():
        lost = clutch.poses(right(None), view())
        np.testing.assert_array_equal(lost.T_world_hands, start.T_world_hands)
        back = np.array([0.2, 0.1, 0.0])
    found = clutch.poses(right(poses.pose(place + back)), view())
    np.testing.assert_array_equal(found.T_world_hands, start.T_world_hands)


def test_silence_stands_still_and_holds() -> None:
    clutch = Clutch()
    walk = np.array([1.0, 0.0, 0.0])
    here = poses.pose([0.0, 0.0, 1.0])
    going = clutch.poses(right(here, walk=walk), view())
    assert going.velocity[0] > 0.4
    silent = clutch.poses(right(poses.pose(STEP), walk=walk, age_s=SILENCE_S + 0.01), view())
    assert not silent.velocity.any()
    np.testing.assert_array_equal(silent.T_world_hands, going.T_world_hands)


@pytest.mark.parametrize(("moved", "follows"), [(0.05, True), (0.2, False)])
def test_after_a_silence_a_hand_goes_on_if_it_is_near(moved: float, follows: bool) -> None:
    clutch = Clutch()
    here, there = poses.pose([0.0, 0.0, 1.0]), poses.pose([moved, 0.0, 1.0])
    start = clutch.poses(right(here), view()).T_world_hands[1, 0, 3]
    clutch.poses(right(here, age_s=1.0), view())
    assert clutch.poses(right(there), view()).T_world_hands[1, 0, 3] == pytest.approx(start + moved * follows)


def test_small_sticks_do_nothing() -> None:
    asked = Clutch().poses(Controls(walk=np.array([0.1, -0.1, 0.1])), view())
    assert not asked.velocity.any()


def test_hands_go_with_a_robot_that_walks_and_stay_in_the_world_when_it_stands() -> None:
    clutch = Clutch()
    walking, standing = Controls(walk=np.array([1.0, 0.0, 0.0])), Controls()
    start = clutch.poses(standing, view()).T_world_hands
    swayed = clutch.poses(standing, view(poses.planar(0.02, 0.01, 0.05))).T_world_hands
    np.testing.assert_array_equal(swayed, start)
    clutch.poses(walking, view())
    ahead = poses.planar(0.3, 0.1, 0.4)
    np.testing.assert_allclose(clutch.poses(walking, view(ahead)).T_world_hands, ahead @ start, atol=1e-12)
    further = poses.planar(0.35, 0.1, 0.4)  # it still steps after the stick was let go
    for _ in range(SETTLING_STEPS):
        rested = clutch.poses(standing, view(further)).T_world_hands
    np.testing.assert_allclose(rested, further @ start, atol=1e-12)
    swayed = clutch.poses(standing, view(poses.planar(0.37, 0.1, 0.4))).T_world_hands
    np.testing.assert_allclose(swayed, further @ start, atol=1e-12)


def test_a_hand_engaged_while_walking_keeps_its_offset() -> None:
    clutch = Clutch()
    walk = np.array([1.0, 0.0, 0.0])
    here = poses.pose([0.0, 0.0, 1.0])
    start = clutch.poses(right(here, walk=walk), view()).T_world_hands[1]
    ahead = poses.planar(0.1, 0.0, 0.2)
    asked = clutch.poses(right(poses.pose(STEP + np.array([0.0, 0.0, 1.0])), walk=walk), view(ahead)).T_world_hands[1]
    expected = ahead @ start
    expected[:3, 3] += ahead[:3, :3] @ STEP
    np.testing.assert_allclose(asked, expected, atol=1e-9)


def test_keys_move_the_hand_and_do_not_run_away() -> None:
    clutch = Clutch()
    hand = HandControls(engaged=True, rate=np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    first = clutch.poses(Controls(right=hand), view()).T_world_hands[1, :3, 3]
    np.testing.assert_allclose(first - view().T_world_hands[1, :3, 3], [0.025, 0.0, 0.0], atol=1e-12)
    for _ in range(50):
        last = clutch.poses(Controls(right=hand), view()).T_world_hands[1, :3, 3]
    assert 0.0 < np.linalg.norm(last - view().T_world_hands[1, :3, 3]) <= LEASH_M


def test_a_closed_gripper_stays_closed_until_the_trigger_has_been_pressed_again() -> None:
    clutch = Clutch()
    here = poses.pose([0.0, 0.0, 1.0])
    assert clutch.poses(right(here, grip=1.0), view()).grippers[1] == 1.0
    assert clutch.poses(right(here, engaged=False), view()).grippers[1] == 1.0
    assert clutch.poses(right(here, grip=0.0), view()).grippers[1] == 1.0
    assert clutch.poses(right(here, grip=0.95), view()).grippers[1] == 0.95
    assert clutch.poses(right(here, grip=0.0), view()).grippers[1] == 0.0


def test_a_head_that_goes_down_takes_the_robots_head_down() -> None:
    clutch = Clutch()
    here = poses.pose([0.0, 0.0, 1.0])
    clutch.poses(right(here, head=poses.pose([0.0, 0.0, 1.6])), view())
    asked = clutch.poses(right(here, head=poses.pose([0.05, 0.0, 1.4])), view())
    assert asked.T_world_head is not None
    np.testing.assert_allclose(asked.T_world_head[:3, 3] - view().T_world_head[:3, 3], [0.05, 0.0, -0.2], atol=1e-12)


def test_buttons_squat_and_rise() -> None:
    clutch = Clutch()
    for _ in range(10):
        down = clutch.poses(Controls(lift=-1.0), view())
    assert down.T_world_head is not None
    assert down.T_world_head[2, 3] - view().T_world_head[2, 3] == pytest.approx(-0.2)
    for _ in range(12):
        up = clutch.poses(Controls(lift=1.0), view())
    assert up.T_world_head is None


def test_a_robot_that_squats_after_going_back_rises_step_by_step() -> None:
    clutch = Clutch()
    for _ in range(10):
        down = clutch.poses(Controls(lift=-1.0), view())
    assert down.T_world_head is not None and clutch.squat == pytest.approx(-0.2)
    clutch.reset(down.T_world_hands, down.grippers, down.T_world_head, clutch.squat)
    up = clutch.poses(Controls(lift=1.0), view())
    assert up.T_world_head is not None
    assert up.T_world_head[2, 3] - down.T_world_head[2, 3] == pytest.approx(0.02)


def test_another_operator_begins_anew() -> None:
    """The first one falls silent with a closed hand; the second one's hand is turned otherwise, its trigger open."""
    clutch = Clutch()
    first = poses.pose([0.3, 0.0, 1.0])
    clutch.poses(right(first, grip=1.0, driver=1), view())
    before = clutch.poses(right(first, grip=1.0, driver=1), view())
    clutch.poses(right(first, grip=1.0, driver=1, age_s=1.0), view())
    turned = poses.from_rotation(poses.rotation_from_rpy([0.0, 1.5, 0.0]), [0.3, 0.0, 1.0])
    asked = clutch.poses(right(turned, grip=0.0, driver=2), view())
    np.testing.assert_allclose(asked.T_world_hands, before.T_world_hands)
    assert asked.grippers[1] == 1.0
    assert clutch.poses(right(turned, grip=0.95, driver=2), view()).grippers[1] == 0.95


def test_a_robot_that_stays_is_held_as_it_is_in_a_new_world() -> None:
    clutch, moved = Clutch(), poses.planar(1.0, 2.0, 0.5)
    clutch.poses(Controls(lift=-1.0), view())
    clutch.reset(view().T_world_hands, np.array([1.0, 0.0]), view().T_world_head, clutch.squat)
    squat = clutch.squat
    clutch.rebase(view(moved))
    asked = clutch.poses(Controls(), view(moved))
    np.testing.assert_allclose(asked.T_world_hands, view(moved).T_world_hands)
    np.testing.assert_allclose(asked.T_world_head, view(moved).T_world_head)
    assert asked.grippers.tolist() == [1.0, 0.0] and clutch.squat == squat < 0.0
