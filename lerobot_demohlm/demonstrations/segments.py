"""What a demonstration is cut into: events of its hands, and the segments between them."""

from dataclasses import dataclass
from typing import Literal

Anchor = Literal["body", "eef_heading", "eef", "root", "world", "base"]
"""Frame in which the motion after the switch is repeated: the end effector's origin with the root's heading, the whole
end-effector pose, the root, or the end effector's origin with the world's axes, each frozen at the switch; or the base
as it moves on, for hands that hold something while the robot walks. "body" is no offset of the hands but the places on
the robot itself that they come to: a policy that has lifted something sees no more from how low, only where it is."""

ANCHORS: tuple[Anchor, ...] = ("body", "eef_heading", "eef", "root", "world", "base")


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something a hand did.

    Attributes:
        tick: When it began.
        hand: "left" or "right".
        kind: "touch" or "release" of an object, "close" or "open" of the gripper.
        object: The object; None for gripper events.
    """

    tick: int
    hand: str
    kind: Literal["touch", "release", "close", "open"]
    object: str | None = None


@dataclass(frozen=True, kw_only=True)
class Segment:
    """What a hand follows during ticks [start, stop) of the demonstration.

    Attributes:
        hand: "left" or "right".
        kind: "object": its pose relative to the object counts; "proprioception": its motion relative to the anchor.
        start: First tick.
        stop: Tick after the last one.
        object: The object that it is about to touch, or has touched; None for a hand that touches nothing.
        anchor: Frame of a proprioception segment.
        held: What the hand holds while it follows an object: the pose of the held thing relative to the object counts.
    """

    hand: str
    kind: Literal["object", "proprioception"]
    start: int
    stop: int
    object: str | None
    anchor: Anchor = "eef_heading"
    held: str | None = None
