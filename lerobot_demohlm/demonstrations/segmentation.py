"""A demonstration -> contact events -> for each hand, the segments in which it follows an object or the robot.

Before a hand touches an object it follows the object (pre-manipulation); from the touch on it follows the robot
(manipulation), until it lets go and heads for another object. A gripper that closes just before it
presses begins that touch; what an open one brushes against, before and after it holds it, it has not touched. Hands
that take one object at about the same time switch together. A hand that takes an object out of the other's follows it
anew from where the other has brought it to rest. Once the demonstration walks, hands that hold something follow the
base. A thing that has a goal follows the goal once it has been lifted clear and carried there: so a demonstration may
be about any number of objects, one after the other.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from gym_demohlm import poses
from gym_demohlm.arithmetic import norm
from gym_demohlm.control import command
from gym_demohlm.errors import DemonstrationError
from gym_demohlm.files import replace_text
from gym_demohlm.robot import g1
from gym_demohlm.task import DEFAULT_REGION, MotionFrame, Task
from lerobot_demohlm.demonstrations.demonstration import (
    CONTACT_FORCE_N,
    CORRECTIONS_PATH,
    Demonstration,
    require_contact,
)
from lerobot_demohlm.demonstrations.segments import ANCHORS, Anchor, Event, Segment

CONTACT_TICKS = 2  # a touch or a release counts once it has lasted this long (0.2 s)
TOGETHER_TICKS = 8  # hands that take one object within this time act together (0.8 s)
RETOUCH_TICKS = 6  # a hand that lets go of an object and touches it again within this time has not let go (0.6 s)
GRIPPER_CLOSED = 0.5  # of the command, 0 open .. 1 closed
_ANCHOR_OF: dict[MotionFrame, Anchor] = {"robot": "body", "hands": "eef_heading", "scene": "eef"}
REST_M, REST_RAD = 0.01, 0.1  # an object this near to where it will be touched has come to rest
MIN_REST_TICKS = 3
UNSTEADY = (1.0, 2.0, 4.0, 8.0)  # times that near, the first that will do, where an unsteady hand holds it for a grip
REACH_TICKS = 20  # an object that comes to rest later before it is touched does so too late (2 s)
CLEAR_M = 0.05  # an object that is so far from where it was taken is clear of what it lay on


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return [start, stop) of the stretches in which a flag (T,) holds, in the order of time."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _runs(active: np.ndarray, min_ticks: int) -> list[tuple[int, int]]:
    """Return [start, stop) of the stretches in which a flag (T,) holds, shorter gaps and then shorter runs dropped."""
    filled = active.copy()
    for start, stop in stretches(~active):
        if stop - start < min_ticks and start > 0 and stop < len(active):
            filled[start:stop] = True
    return [(start, stop) for start, stop in stretches(filled) if stop - start >= min_ticks]


def contact_events(
    contact_forces: np.ndarray,
    pairs: Sequence[tuple[str, str]],
    force_n: float = CONTACT_FORCE_N,
    min_ticks: int = CONTACT_TICKS,
) -> list[Event]:
    """Return touches and releases in the order of time.

    Args:
        contact_forces: (T, P) normal forces [N].
        pairs: P pairs of hand and object.
        force_n: A hand touches from this force on [N].
        min_ticks: A touch, or the gap after it, counts once it has lasted this many ticks.
    """
    events = []
    for column, (hand, name) in enumerate(pairs):
        for start, stop in _runs(contact_forces[:, column] >= force_n, min_ticks):
            events.append(Event(tick=start, hand=hand, kind="touch", object=name))
            if stop < len(contact_forces):
                events.append(Event(tick=stop, hand=hand, kind="release", object=name))
    return sorted(events, key=lambda event: (event.tick, event.hand, event.kind))


def gripper_events(action: np.ndarray) -> list[Event]:
    """Return when gripper commands (T, 23) close and open."""
    events = []
    for column, hand in enumerate(g1.SIDES):
        closed = action[:, command.GRIPPERS][:, column] >= GRIPPER_CLOSED
        for tick in np.flatnonzero(np.diff(closed.astype(np.int8))) + 1:
            events.append(Event(tick=int(tick), hand=hand, kind="close" if closed[tick] else "open"))
    return sorted(events, key=lambda event: (event.tick, event.hand))


def events(demonstration: Demonstration, task: Task) -> list[Event]:
    """Return all contact and gripper events of a demonstration in the order of time.

    Raises:
        DemonstrationError: It has not one force for each contact pair of the task.
    """
    got, expected = demonstration.contact_forces.shape[1], len(task.contact_pairs)
    if got != expected:
        raise DemonstrationError(
            f"a demonstration with forces of {got} pairs of hand and object",
            f"{expected}, the contact pairs of the task {task.name}",
            "record it again, or pass the task that it was recorded with",
        )
    found = contact_events(demonstration.contact_forces, task.contact_pairs)
    if task.hands == "gripper":
        found += gripper_events(demonstration.action)
    return sorted(found, key=lambda event: (event.tick, event.hand, event.kind))


def segment(demonstration: Demonstration, task: Task, scattered: bool | None = None) -> list[Segment]:
    """Cut a demonstration into segments: by its contacts, or as its hand-made corrections say.

    Args:
        demonstration: The recording.
        task: Its task, which names hands, objects and contact pairs, and in what frame motions are repeated.
        scattered: Whether objects start each by itself, so that what is held follows its goal; as in most of the task's
            regions by default.

    Returns:
        Segments ordered by hand and time; those of a hand cover [0, T) without gaps.

    Raises:
        DemonstrationError: No hand touches anything, or the corrections do not fit.
    """
    require_contact(demonstration)
    if demonstration.corrections is not None:
        return _corrected(demonstration, task)
    length = len(demonstration)
    found = events(demonstration, task)
    switches = {hand: _switches([event for event in found if event.hand == hand]) for hand in g1.SIDES}
    switches = _together(switches)
    anchor = _ANCHOR_OF[task.motion_frame]
    tracks = {hand: _track(hand, switches[hand], length, anchor) for hand in g1.SIDES}
    segments = []
    for hand, other in zip(g1.SIDES, reversed(g1.SIDES), strict=True):
        taken_over = _cut_at_rest(demonstration, task, tracks[hand], switches[other])
        if task.is_scattered(DEFAULT_REGION) if scattered is None else scattered:
            taken_over = _cut_at_goals(demonstration, task, taken_over)
        segments += _cut_at_steps(demonstration, taken_over)
    return segments


def require_approach(segments: Sequence[Segment]) -> None:
    """Raise ``DemonstrationError`` where no hand comes to an object: every attempt begins with that."""
    if not any(entry.kind == "object" for entry in segments):
        raise DemonstrationError(
            "segments none of which follows an object",
            "a hand that comes to an object",
            "begin the recording with free hands, or mend meta/segments.json",
        )


def _cut_at_rest(
    demonstration: Demonstration, task: Task, track: list[Segment], others: list[tuple[int, int | None, str]]
) -> list[Segment]:
    """Cut approaches to an object that the other hand takes first at the tick at which it is brought to rest."""
    names = [entry.name for entry in task.objects]
    gripping = gripper_events(demonstration.action) if task.hands == "gripper" else []
    closings = {(event.tick, event.hand) for event in gripping if event.kind == "close"}
    cut = []
    for entry in track:
        taken = [tick for tick, _, name in others if name == entry.object and entry.start <= tick < entry.stop]
        if entry.kind == "object" and taken:
            assert entry.object is not None  # object segments have one
            T = demonstration.T_world_objects[: entry.stop, names.index(entry.object)]
            shares = UNSTEADY if (entry.stop, entry.hand) in closings else UNSTEADY[:1]
            rests = [max(entry.start, _rest(T, share)) for share in shares]
            rest = next((tick for tick in rests if tick <= entry.stop - REACH_TICKS), rests[0])
            if max(taken) < rest <= entry.stop - MIN_REST_TICKS:
                cut += [replace(entry, stop=rest), replace(entry, start=rest)]
                continue
        cut.append(entry)
    return cut


def _rest(T: np.ndarray, share: float) -> int:
    """Return from when on an object's poses (T, 4, 4) are nearer to the last one than a multiple of ``REST_M``."""
    distance = norm(T[:, :3, 3] - T[-1, :3, 3])
    angle = norm(poses.rotation_vector(T[:, :3, :3] @ T[-1, :3, :3].T))
    moving = np.flatnonzero((distance > share * REST_M) | (angle > share * REST_RAD))
    return int(moving[-1]) + 1 if len(moving) else 0


def _cut_at_goals(demonstration: Demonstration, task: Task, track: list[Segment]) -> list[Segment]:
    """Cut the motion of a hand that holds what has a goal: after the walk there, or once it has been lifted clear."""
    names = [entry.name for entry in task.objects]
    walks = np.abs(demonstration.action[:, command.VELOCITY]).max(axis=1) > 0.0
    cut = []
    for entry in track:
        goal = task.goals.get(entry.object or "")
        if entry.kind == "object" or goal is None:
            cut.append(entry)
            continue
        way = demonstration.T_world_objects[entry.start : entry.stop, names.index(str(entry.object)), :3, 3]
        away, steps = np.flatnonzero(norm(way - way[0]) > CLEAR_M), np.flatnonzero(walks[entry.start : entry.stop])
        if not len(away):
            cut.append(entry)
            continue
        begin = entry.start + int(steps[-1] + 1 if len(steps) else away[0])
        cut.append(replace(entry, stop=begin))
        if begin < entry.stop:
            cut.append(replace(entry, kind="object", start=begin, object=goal.object, held=entry.object))
    return cut


def _cut_at_steps(demonstration: Demonstration, track: list[Segment]) -> list[Segment]:
    """Cut the motion of hands where the robot begins to walk; from there on they follow the base.

    Also once it stands again: hands told to stay in the world, on a cart that rolls, would have the torso lean after
    them while the leaning moves the base back.
    """
    walks = np.abs(demonstration.action[:, command.VELOCITY]).max(axis=1) > 0.0
    cut = []
    for entry in track:
        steps = entry.start + np.flatnonzero(walks[entry.start : entry.stop])
        if entry.kind == "object" or not len(steps):
            cut.append(entry)
            continue
        first = int(steps[0])
        if first > entry.start:
            cut.append(replace(entry, stop=first))
        cut.append(replace(entry, start=first, anchor="base"))
    return cut


def _switches(found: list[Event]) -> list[tuple[int, int | None, str]]:
    """Return (touch, release, object) of a hand; a gripper closing just before or during a touch brings it forward."""
    touches = [event for event in found if event.kind == "touch"]
    switches: list[tuple[int, int | None, str]] = []
    for event in touches:
        releases = [e.tick for e in found if e.kind == "release" and e.object == event.object and e.tick > event.tick]
        release = min(releases, default=None)
        closing = [e.tick for e in found if e.kind == "close" and 0 <= event.tick - e.tick <= TOGETHER_TICKS]
        assert event.object is not None  # touches have one
        if switches and switches[-1][2] == event.object:
            touch, let_go, name = switches[-1]
            if let_go is not None and event.tick - let_go <= RETOUCH_TICKS:
                switches[-1] = (touch, release, name)
                continue
        switches.append((min([event.tick, *closing]), release, event.object))
    return _taken(switches, found)


def _taken(switches: list[tuple[int, int | None, str]], found: list[Event]) -> list[tuple[int, int | None, str]]:
    """Leave out touches with the open gripper, of what the hand takes with the closed one at another time."""
    opens = [event.tick for event in found if event.kind == "open"]
    grips = [(e.tick, min([tick for tick in opens if tick > e.tick], default=None)) for e in found if e.kind == "close"]

    def gripped(touch: int, release: int | None) -> bool:
        return any(
            (release is None or close < release) and (opened is None or touch < opened) for close, opened in grips
        )

    def begin(touch: int, release: int | None) -> int:
        """A touch begins as the gripper closes; what the open one did before is a brush."""
        inside = [close for close, _ in grips if touch < close and (release is None or close < release)]
        shut = any(close <= touch and (opened is None or touch < opened) for close, opened in grips)
        return touch if shut or not inside else inside[0]

    held = {name for touch, release, name in switches if gripped(touch, release)}
    kept = [switch for switch in switches if switch[2] not in held or gripped(switch[0], switch[1])]
    return [(begin(touch, release), release, name) for touch, release, name in kept]


def _together(
    switches: dict[str, list[tuple[int, int | None, str]]],
) -> dict[str, list[tuple[int, int | None, str]]]:
    """Let hands that take one object at about the same time switch at the first touch."""
    together = {hand: list(found) for hand, found in switches.items()}
    for i, (touch, release, name) in enumerate(switches["left"]):
        for j, (other, other_release, other_name) in enumerate(switches["right"]):
            if name == other_name and abs(touch - other) <= TOGETHER_TICKS:
                together["left"][i] = (min(touch, other), release, name)
                together["right"][j] = (min(touch, other), other_release, name)
    return together


def _track(hand: str, switches: list[tuple[int, int | None, str]], length: int, anchor: Anchor) -> list[Segment]:
    """Return a hand's segments: to each object, then with it until the approach to the next one begins."""
    if not switches:  # it touches nothing: it keeps its place on the robot
        return [Segment(hand=hand, kind="proprioception", start=0, stop=length, object=None, anchor="root")]
    segments, start = [], 0
    for index, (touch, release, name) in enumerate(switches):
        last = index == len(switches) - 1
        following = None if last else switches[index + 1]
        stop = length if following is None else (release if release is not None else following[0])
        begin = max(touch, start)
        if stop > begin:  # else it takes the next object in the same tick, and comes to that one
            if touch > start:
                segments.append(Segment(hand=hand, kind="object", start=start, stop=touch, object=name))
            segments.append(
                Segment(hand=hand, kind="proprioception", start=begin, stop=stop, object=name, anchor=anchor)
            )
            start = stop
    return segments


def _corrected(demonstration: Demonstration, task: Task) -> list[Segment]:
    """Read segments from the sidecar: {"segments": [{"hand", "kind", "start", "stop", "object", "anchor"}, ...]}."""
    corrections: dict[str, Any] = demonstration.corrections or {}
    names = [entry.name for entry in task.objects]  # a list: what is asked may be unhashable
    try:
        segments = [Segment(**entry) for entry in corrections["segments"]]
        if any(type(tick) is not int for entry in segments for tick in (entry.start, entry.stop)):
            raise TypeError("ticks are whole numbers")
    except (KeyError, TypeError) as error:
        raise DemonstrationError(
            f"corrections that cannot be read ({error})",
            '{"segments": [{"hand", "kind", "start", "stop", "object", "anchor"}, ...]}',
            "mend meta/segments.json, or remove it",
        ) from error
    segments.sort(key=lambda entry: (g1.SIDES.index(entry.hand) if entry.hand in g1.SIDES else -1, entry.start))
    for hand in g1.SIDES:
        track = [entry for entry in segments if entry.hand == hand]
        edges = [0, *(entry.stop for entry in track)]
        fits = [entry.start for entry in track] == edges[:-1] and edges[-1] == len(demonstration)
        if not fits or any(entry.stop <= entry.start for entry in track):
            raise DemonstrationError(
                f"corrections whose {hand} segments are {[(entry.start, entry.stop) for entry in track]}",
                f"segments from 0 to {len(demonstration)} without gaps",
                "mend meta/segments.json, or remove it",
            )
    for entry in segments:
        known = entry.object in names or (entry.object is None and entry.kind == "proprioception")
        known = known and entry.hand in g1.SIDES and entry.anchor in ANCHORS and entry.held in (None, *task.goals)
        if entry.kind not in ("object", "proprioception") or not known:
            raise DemonstrationError(
                f"a corrected segment {entry}",
                f"a hand of {g1.SIDES}, kind object or proprioception, an object of {sorted(names)}, "
                f"an anchor of {ANCHORS}, held of {sorted(task.goals) or 'none'}",
                "mend meta/segments.json, or remove it",
            )
    return segments


def groups(segments: Sequence[Segment]) -> list[tuple[Segment, ...]]:
    """Put segments of both hands that share object, kind and start together: they share one anchor."""
    grouped: dict[tuple[str, int, str | None], list[Segment]] = {}
    for entry in segments:
        key = (entry.kind, entry.start, entry.object or entry.hand)
        grouped.setdefault(key, []).append(entry)
    return [tuple(group) for _, group in sorted(grouped.items(), key=lambda item: item[0][1])]


def write_corrections(demonstration: Demonstration, task: Task, root: Path) -> Path:
    """Write the segments of a demonstration into its directory, to be corrected by hand; return the file.

    Args:
        demonstration: Of the task.
        task: Of the demonstration.
        root: Directory of the demonstration.
    """
    path = root / CORRECTIONS_PATH
    content = {"segments": [asdict(entry) for entry in segment(demonstration, task)]}
    replace_text(path, json.dumps(content, indent=2) + "\n")
    return path
