"""Contact forces become events, events become segments that cover the demonstration, corrections win."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from gym_demohlm.control import command
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.registry import get_task
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations import demonstration as demonstrations
from lerobot_demohlm.demonstrations import segmentation
from lerobot_demohlm.demonstrations.demonstration import Demonstration
from lerobot_demohlm.demonstrations.segments import Event, Segment

TASK = get_task("LiftBox")
PAIRS = TASK.contact_pairs


@pytest.fixture(scope="module")
def demonstration() -> Demonstration:
    return demonstrations.load(task=TASK)


def forces(length: int, **touches: tuple[int, int]) -> np.ndarray:
    """Return forces (length, 2): 10 N from start to stop for each hand named."""
    array = np.zeros((length, 2))
    for hand, (start, stop) in touches.items():
        array[start:stop, [pair[0] for pair in PAIRS].index(hand)] = 10.0
    return array


def with_forces(demonstration: Demonstration, **touches: tuple[int, int]) -> Demonstration:
    return dataclasses.replace(demonstration, contact_forces=forces(len(demonstration), **touches))


def test_events_are_touches_and_releases_in_order() -> None:
    found = segmentation.contact_events(forces(30, left=(5, 20), right=(7, 30)), PAIRS)
    assert found == [
        Event(tick=5, hand="left", kind="touch", object="box"),
        Event(tick=7, hand="right", kind="touch", object="box"),
        Event(tick=20, hand="left", kind="release", object="box"),
    ]


def test_a_brush_is_no_touch_and_a_slip_no_release() -> None:
    brush = forces(30, left=(5, 6))
    assert segmentation.contact_events(brush, PAIRS) == []
    slip = forces(30, left=(5, 25))
    slip[12, 0] = 0.0
    assert [event.tick for event in segmentation.contact_events(slip, PAIRS)] == [5, 25]
    weak = forces(30, left=(5, 25)) * 0.04
    assert segmentation.contact_events(weak, PAIRS) == []


def test_grippers_close_and_open() -> None:
    action = np.zeros((20, command.SIZE), dtype=np.float32)
    action[6:15, -1] = 1.0
    assert segmentation.gripper_events(action) == [
        Event(tick=6, hand="right", kind="close"),
        Event(tick=15, hand="right", kind="open"),
    ]


def test_the_packaged_demonstration_has_one_switch_for_both_hands(demonstration: Demonstration) -> None:
    segments = segmentation.segment(demonstration, TASK)
    assert [(entry.hand, entry.kind) for entry in segments] == [
        ("left", "object"), ("left", "proprioception"), ("right", "object"), ("right", "proprioception")
    ]  # fmt: skip
    assert len({entry.start for entry in segments if entry.kind == "proprioception"}) == 1
    switch = segments[1].start
    touch = min(event.tick for event in segmentation.events(demonstration, TASK) if event.kind == "touch")
    assert switch == touch
    # Until then the box stands still; afterwards it rises.
    heights = demonstration.object_poses[:, 0, 2]
    assert np.ptp(heights[: switch + 1]) < 0.01
    assert heights[-1] - heights[0] > 0.3
    assert [len(group) for group in segmentation.groups(segments)] == [2, 2]


@pytest.mark.parametrize("gap", [0, 3, 8])
def test_hands_that_touch_together_switch_together(demonstration: Demonstration, gap: int) -> None:
    segments = segmentation.segment(with_forces(demonstration, left=(20, 60), right=(20 + gap, 60)), TASK)
    assert {entry.start for entry in segments if entry.kind == "proprioception"} == {20}


def test_hands_that_touch_apart_switch_apart(demonstration: Demonstration) -> None:
    segments = segmentation.segment(with_forces(demonstration, left=(20, 60), right=(40, 60)), TASK)
    assert {entry.hand: entry.start for entry in segments if entry.kind == "proprioception"} == {
        "left": 20,
        "right": 40,
    }


def test_an_idle_hand_keeps_its_place_on_the_robot(demonstration: Demonstration) -> None:
    segments = segmentation.segment(with_forces(demonstration, right=(20, 60)), TASK)
    assert segments[0] == Segment(
        hand="left", kind="proprioception", start=0, stop=len(demonstration), object=None, anchor="root"
    )


def test_a_second_touch_after_a_release_is_a_second_approach(demonstration: Demonstration) -> None:
    touches = forces(len(demonstration), left=(20, 30))
    touches[40:50, 0] = 10.0
    segments = segmentation.segment(dataclasses.replace(demonstration, contact_forces=touches), TASK)
    left = [(entry.kind, entry.start, entry.stop) for entry in segments if entry.hand == "left"]
    assert left == [
        ("object", 0, 20),
        ("proprioception", 20, 30),
        ("object", 30, 40),
        ("proprioception", 40, len(demonstration)),
    ]


@pytest.mark.parametrize("seed", range(20))
def test_segments_cover_every_tick_once(demonstration: Demonstration, seed: int) -> None:
    """Whatever the forces, a hand follows exactly one thing at any tick."""
    rng = np.random.default_rng(seed)
    noise = np.repeat(rng.uniform(0, 8, size=(-(-len(demonstration) // 6), 2)) * rng.integers(0, 2, size=2), 6, axis=0)
    noise[:6] = [5.0, 0.0]
    segments = segmentation.segment(
        dataclasses.replace(demonstration, contact_forces=noise[: len(demonstration)]), TASK
    )
    for hand in ("left", "right"):
        covered = [tick for entry in segments if entry.hand == hand for tick in range(entry.start, entry.stop)]
        assert covered == list(range(len(demonstration)))


def test_no_contact_is_an_error(demonstration: Demonstration) -> None:
    with pytest.raises(DemonstrationError, match="without contact"):
        segmentation.segment(with_forces(demonstration), TASK)


def corrections(length: int, **changes: object) -> dict[str, Any]:
    entries: list[dict[str, Any]] = [
        {"hand": hand, "kind": kind, "start": start, "stop": stop, "object": "box", "anchor": "root"}
        for hand in ("left", "right")
        for kind, start, stop in (("object", 0, 10), ("proprioception", 10, length))
    ]
    entries[1] |= changes
    return {"segments": entries}


def test_corrections_replace_what_was_found(demonstration: Demonstration) -> None:
    corrected = dataclasses.replace(demonstration, corrections=corrections(len(demonstration)))
    segments = segmentation.segment(corrected, TASK)
    assert [entry.start for entry in segments] == [0, 10, 0, 10]
    assert segments[1].anchor == "root"
    assert corrected.content_hash != demonstration.content_hash


@pytest.mark.parametrize(
    "changes", [{"start": 12}, {"stop": 5}, {"object": "cup"}, {"anchor": "moon"}, {"kind": "dance"}, {"colour": 1}]
)
def test_corrections_that_do_not_fit_are_errors(demonstration: Demonstration, changes: dict[str, object]) -> None:
    wrong = dataclasses.replace(demonstration, corrections=corrections(len(demonstration), **changes))
    with pytest.raises(DemonstrationError, match=r"segments\.json"):
        segmentation.segment(wrong, TASK)


def test_a_recording_in_which_no_hand_comes_to_anything_is_an_error(demonstration: Demonstration) -> None:
    """Nothing could be generated from it: attempts begin with an approach."""
    edited = corrections(len(demonstration))
    for entry in edited["segments"]:
        entry["kind"] = "proprioception"
    touching = with_forces(demonstration, left=(0, 30), right=(0, 30))
    for wrong in (dataclasses.replace(demonstration, corrections=edited), touching):
        with pytest.raises(DemonstrationError, match=r"none of which follows an object.*segments\.json"):
            segmentation.require_approach(segmentation.segment(wrong, TASK))
    segmentation.require_approach(segmentation.segment(demonstration, TASK))


def test_only_what_has_a_goal_is_held_in_corrections(demonstration: Demonstration) -> None:
    wrong = dataclasses.replace(demonstration, corrections=corrections(len(demonstration), held="box"))
    with pytest.raises(DemonstrationError, match="held of none"):
        segmentation.segment(wrong, TASK)


def test_a_short_gap_is_no_second_approach(demonstration: Demonstration) -> None:
    touches = forces(len(demonstration), left=(20, 30))
    touches[34:50, 0] = 10.0
    segments = segmentation.segment(dataclasses.replace(demonstration, contact_forces=touches), TASK)
    left = [(entry.kind, entry.start, entry.stop) for entry in segments if entry.hand == "left"]
    assert left == [("object", 0, 20), ("proprioception", 20, len(demonstration))]


def test_a_hand_that_takes_over_follows_the_object_from_where_it_came_to_rest(demonstration: Demonstration) -> None:
    """The right hand has the box from tick 20 and brings it to rest at 40; the left one takes it at 60."""
    objects = demonstration.object_poses.copy()
    objects[:] = objects[0]
    objects[:, 0, 1] += np.clip((np.arange(len(objects)) - 25) / 15, 0, 1) * 0.3
    handed = dataclasses.replace(with_forces(demonstration, right=(20, 75), left=(60, 80)), object_poses=objects)
    segments = segmentation.segment(handed, TASK)
    left = [(entry.kind, entry.start, entry.stop) for entry in segments if entry.hand == "left"]
    assert [entry[0] for entry in left] == ["object", "object", "proprioception"]
    assert left[0][2] == left[1][1] and 38 <= left[1][1] <= 41
    right = [(entry.kind, entry.start) for entry in segments if entry.hand == "right"]
    assert right == [("object", 0), ("proprioception", 20)]
    # An object that is still on its way is met where it was seen first.
    objects[:, 0, 1] = np.arange(len(objects)) * 0.01
    moving = segmentation.segment(dataclasses.replace(handed, object_poses=objects), TASK)
    assert [entry.kind for entry in moving if entry.hand == "left"] == ["object", "proprioception"]


def test_hands_follow_the_base_once_it_walks(demonstration: Demonstration) -> None:
    action = demonstration.action.copy()
    action[40:55, 0] = 0.3
    walking = dataclasses.replace(with_forces(demonstration, left=(20, 80), right=(20, 80)), action=action)
    for hand in ("left", "right"):
        track = [entry for entry in segmentation.segment(walking, TASK) if entry.hand == hand]
        assert [(entry.kind, entry.anchor, entry.start) for entry in track] == [
            ("object", "eef_heading", 0),
            ("proprioception", "body", 20),
            ("proprioception", "base", 40),
        ]


def test_a_replaced_task_is_segmented_by_itself(demonstration: Demonstration) -> None:
    """Nothing is looked up: the registered task of that name says otherwise, or there is none."""
    touching = with_forces(demonstration, left=(20, 60), right=(20, 60))
    registered = segmentation.segment(touching, TASK)
    assert {entry.anchor for entry in registered if entry.kind == "proprioception"} == {"body"}
    by_hands = segmentation.segment(touching, dataclasses.replace(TASK, name="Unregistered", motion_frame="hands"))
    assert {entry.anchor for entry in by_hands if entry.kind == "proprioception"} == {"eef_heading"}
    swapped = dataclasses.replace(TASK, contact_pairs=TASK.contact_pairs[::-1])
    events = segmentation.events(with_forces(demonstration, left=(20, 60)), swapped)
    assert [(event.hand, event.tick) for event in events] == [("right", 20), ("right", 60)]
    closing = demonstration.action.copy()
    closing[30:, command.GRIPPERS] = 1.0
    gripping = dataclasses.replace(touching, action=closing)
    for task, kinds in ((TASK, set()), (dataclasses.replace(TASK, hands="gripper"), {"close"})):
        found = {event.kind for event in segmentation.events(gripping, task)}
        assert found - {"touch", "release"} == kinds


def test_a_replaced_task_takes_corrections_of_its_own_objects(demonstration: Demonstration) -> None:
    crate = dataclasses.replace(TASK.objects[0], name="crate")
    pairs = (("left", "crate"), ("right", "crate"))
    task = dataclasses.replace(TASK, objects=(crate,), gaze_target="crate", contact_pairs=pairs)
    corrected = dataclasses.replace(demonstration, corrections=corrections(len(demonstration)))
    with pytest.raises(DemonstrationError, match="crate"):
        segmentation.segment(corrected, task)


def test_a_task_with_other_pairs_is_refused(demonstration: Demonstration) -> None:
    with pytest.raises(DemonstrationError, match="forces of 2 pairs"):
        segmentation.segment(demonstration, dataclasses.replace(TASK, contact_pairs=TASK.contact_pairs[:1]))


def gripping(closes: int, opens: int, **touches: list[tuple[int, int]]) -> tuple[Demonstration, Task]:
    """Return GraspCube's demonstration with other forces, whose right gripper closes and opens at these ticks."""
    task = get_task("GraspCube")
    packaged = demonstrations.load(task=task)
    action, forces = packaged.action.copy(), np.zeros_like(packaged.contact_forces)
    action[:, command.GRIPPERS] = 0.0
    action[closes:opens, command.GRIPPERS.stop - 1] = 1.0
    for hand, stretches in touches.items():
        for start, stop in stretches:
            forces[start:stop, [pair[0] for pair in task.contact_pairs].index(hand)] = 10.0
    return dataclasses.replace(packaged, action=action, contact_forces=forces), task


@pytest.mark.parametrize(
    "touches",
    [
        [(32, 80)],
        [(12, 20), (32, 80)],  # it brushes against it before
        [(32, 60), (70, 76)],  # and after
        [(12, 80)],  # it leans on it until it closes
    ],
)
def test_what_an_open_gripper_brushes_against_it_has_not_taken(touches: list[tuple[int, int]]) -> None:
    demonstration, task = gripping(30, 60, right=touches)
    right = [(entry.kind, entry.start) for entry in segmentation.segment(demonstration, task) if entry.hand == "right"]
    assert right == [("object", 0), ("proprioception", 30)]


def test_a_gripper_that_closes_on_two_things_follows_one_of_them_at_any_tick() -> None:
    """Both touches are brought forward to the closing, and the first thing is never let go."""
    demonstration, task = gripping(48, 80)
    other = dataclasses.replace(task.objects[0], name="other")
    pairs = (("right", "cube"), ("right", "other"))
    task = dataclasses.replace(task, objects=(*task.objects, other), contact_pairs=pairs)
    pressed = np.zeros((len(demonstration), 2))
    pressed[50:, 0] = pressed[52:, 1] = 10.0
    poses = np.repeat(demonstration.object_poses[:, :1], 2, axis=1)
    both = dataclasses.replace(demonstration, contact_forces=pressed, object_poses=poses)
    right = [entry for entry in segmentation.segment(both, task) if entry.hand == "right"]
    assert [(entry.kind, entry.start, entry.stop, entry.object) for entry in right] == [
        ("object", 0, 48, "other"),
        ("proprioception", 48, len(demonstration), "other"),
    ]


def test_an_open_gripper_that_never_closes_takes_by_touching() -> None:
    demonstration, task = gripping(0, 0, right=[(12, 20), (40, 80)])
    right = [(entry.kind, entry.start) for entry in segmentation.segment(demonstration, task) if entry.hand == "right"]
    assert right == [("object", 0), ("proprioception", 12), ("object", 20), ("proprioception", 40)]


@pytest.mark.parametrize(("sway", "rest"), [(0.0, 83), (0.02, 83), (0.05, 90)])
def test_what_is_held_unsteadily_is_met_where_it_is_held(sway: float, rest: int) -> None:
    """The right hand holds out the cube, which sways until just before the left one closes on it at tick 139."""
    task = get_task("ExchangeCube")
    packaged = demonstrations.load(task=task)
    objects = packaged.object_poses.copy()
    objects[90:135, 0, 1] += sway * np.sin(np.arange(45))
    segments = segmentation.segment(dataclasses.replace(packaged, object_poses=objects), task)
    approaches = [entry for entry in segments if entry.hand == "left" and entry.kind == "object"]
    assert len(approaches) == 2
    assert approaches[1].start <= rest and approaches[1].stop == 139
