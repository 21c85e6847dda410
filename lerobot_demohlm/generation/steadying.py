"""A demonstration whose hands stray before they take hold -> the same with hands that go straight there.

A person's hand swings past its goal, comes back, and brushes against the thing that it is about to grip, or pushes it
ahead. Repeated somewhere else, where tables are lower and arms sag otherwise, it runs into them. What the hand did
close to the thing before its gripper closed is replaced by the straight way to where it closed, in the time that it
took. Hands that went straight there, as scripts do, keep their motion, bit for bit.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.robot import g1
from gym_demohlm.task import Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration, pose_numbers
from lerobot_demohlm.demonstrations.segmentation import gripper_events
from lerobot_demohlm.demonstrations.segments import Segment

NEAR_M = 0.12  # from where a gripper closes: there a hand is to go straight
STRAY_M = 0.0075  # that a hand on its way there may move away again, at most
PUSHED_M = 0.005  # by which it may push the thing on its way, at most
BRUSHED_M = 0.06  # that the hand may move the object until then; one that moves it further means to
STILL_M = 0.005  # that a hand which holds something for the other one may move meanwhile
COME_TICKS = 10  # in which it comes to rest
SETTLE_TICKS = 5  # for which it waits there before the gripper closes


def steadied(demonstration: Demonstration, task: Task, segments: Sequence[Segment]) -> Demonstration:
    """Return a demonstration whose hands go straight to where their grippers close.

    Args:
        demonstration: The source.
        task: Of the demonstration.
        segments: What it is cut into.

    Returns:
        The demonstration itself where no hand strays.
    """
    names = [entry.name for entry in task.objects]
    closing = [] if task.hands == "rubber" else [e for e in gripper_events(demonstration.action) if e.kind == "close"]
    ends = {(event.hand, event.tick) for event in closing}
    approaches = [
        entry
        for entry in segments
        if entry.kind == "object" and entry.held is None and (entry.hand, entry.stop) in ends
    ]
    for entry in sorted(approaches, key=lambda entry: entry.stop):
        column = names.index(str(entry.object))
        holding = [
            other.start
            for other in segments
            if (other.kind, other.object) == ("proprioception", entry.object)
            and other.hand != entry.hand
            and other.start < entry.stop <= other.stop
        ]
        if holding and min(holding) < entry.start:
            demonstration = _still(demonstration, entry, column)
        demonstration = _straight(demonstration, entry, column, carried=bool(holding))
    return demonstration


def _straight(demonstration: Demonstration, approach: Segment, column: int, *, carried: bool) -> Demonstration:
    """Return a demonstration in which one approach is straight; the other hand may carry the object there."""
    hand, close = g1.SIDES.index(approach.hand), approach.stop
    T_W_O = demonstration.T_world_objects[approach.start : close + 1, column]
    T_W_E = demonstration.T_world_hands[approach.start : close + 1, hand]
    T_O_E = poses.invert(T_W_O) @ T_W_E
    away = norm(T_O_E[:, :3, 3] - T_O_E[-1, :3, 3])
    far = np.flatnonzero(away > NEAR_M)
    near = int(far[-1]) if len(far) else 0  # the last tick of the approach outside
    strays = float((away - np.minimum.accumulate(away))[near:].max()) > STRAY_M
    pushed = norm(T_W_O[:, :3, 3] - T_W_O[0, :3, 3])
    pushes = not carried and float(pushed.max()) > PUSHED_M
    if len(away) - near <= SETTLE_TICKS or not (strays or pushes):
        return demonstration
    if not carried and float(pushed[-1]) > BRUSHED_M:
        return demonstration
    # What the hand has brushed aside stands where it is taken all the time.
    moved = np.eye(4)
    if not carried:
        first, last = (poses.planar(*poses.to_planar(T)) for T in (T_W_O[0], T_W_O[-1]))
        moved = last @ poses.invert(first)
        objects = demonstration.object_poses.copy()
        objects[approach.start : close, column] = pose_numbers(moved @ T_W_O[0])
        demonstration = replace(demonstration, object_poses=objects)
    T_W_O = demonstration.T_world_objects[approach.start : close + 1, column]
    share = np.minimum(1.0, np.arange(len(away) - near) / (len(away) - near - SETTLE_TICKS))
    share = share * (2.0 - share)
    changed = {}
    T_W_T = demonstration.T_world_targets[approach.start : close + 1, hand]
    for name, path in (("hand_poses", T_W_E), ("hand_targets", T_W_T)):
        begin = poses.invert(T_W_O[near]) @ moved @ path[near]
        end = poses.invert(T_W_O[-1]) @ path[-1]
        way = np.concatenate([moved @ path[:near], T_W_O[near:] @ poses.interpolate(begin, end, share)])
        changed[name] = getattr(demonstration, name).copy()
        changed[name][approach.start : close, hand] = pose_numbers(way[:-1])
    return replace(demonstration, **changed)


def _still(demonstration: Demonstration, approach: Segment, column: int) -> Demonstration:
    """Return a demonstration in which a hand keeps still while it holds what the other one goes to."""
    begin, close, hand = approach.start, approach.stop, 1 - g1.SIDES.index(approach.hand)
    before = slice(max(0, begin - COME_TICKS), begin)
    targets = demonstration.T_world_targets[:, hand]
    if float(norm(targets[begin:close, :3, 3] - targets[close, :3, 3]).max()) <= STILL_M:
        return demonstration
    share = np.arange(1, begin - before.start + 1) / (begin - before.start + 1)
    share = share * share * (3.0 - 2.0 * share)
    changed = {}
    for name, T_W_E in (("hand_poses", demonstration.T_world_hands[:, hand]), ("hand_targets", targets)):
        changed[name] = getattr(demonstration, name).copy()
        changed[name][before, hand] = pose_numbers(poses.interpolate(T_W_E[before], T_W_E[close], share))
        changed[name][begin:close, hand] = changed[name][close, hand]
    objects = demonstration.object_poses.copy()
    objects[begin:close, column] = objects[close, column]
    return replace(demonstration, object_poses=objects, **changed)
