"""Messages from outside: what is understood, what is refused."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_demohlm import poses
from lerobot_demohlm.teleop.web import protocol

JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=20,
)


def message(**changes: object) -> str:
    hand = {"pose": [0.1, 1.2, -0.3, 1, 0, 0, 0], "engaged": True, "grip": 0.4, "rate": [0] * 6}
    content: dict[str, object] = {"type": "input", "seq": 4, "t": 12.5, "device": "headset", "hands": {"right": hand}}
    return json.dumps(content | changes)


def test_axes_are_turned_from_the_room_to_the_robot() -> None:
    parsed = protocol.parse(message())
    assert isinstance(parsed, protocol.Input)
    T = parsed.controls.right.pose
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [0.3, -0.1, 1.2])  # 0.3 m ahead, 0.1 m to the right, 1.2 m up
    assert not parsed.controls.left.engaged


@given(angles=st.tuples(*[st.floats(-3, 3)] * 3), position=st.tuples(*[st.floats(-2, 2)] * 3))
def test_poses_come_back(angles: tuple[float, ...], position: tuple[float, ...]) -> None:
    T = poses.from_rotation(poses.rotation_from_rpy(list(angles)), list(position))
    parsed = protocol.parse(message(head=protocol.room_pose(T)))
    assert isinstance(parsed, protocol.Input) and parsed.controls.head is not None
    np.testing.assert_allclose(parsed.controls.head, T, atol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "3",
        '{"type": "shutdown"}',
        '{"type": "press", "button": "sudo"}',
        '{"type": "press", "button": ["record"]}',
        message(head=[0, 0, 0, 0, 0, 0, 0]),
        message(head=[0, 0, 0, 1, 0, 0]),
        message(head=[float("nan")] * 7),
        message(heading=[0.1]),
        message(heading=float("inf")),
        message(walk=[1, 2]),
        message(walk="fast"),
        message(hands=[1]),
        message(hands={"third": {}}),
        message(hands={"left": {"engaged": 1}}),
        message(seq=-1),
        message(t=None),
        message(device="gun"),
        "[" * 16_000,
        '{"type": "input", "head": ' + "9" * 15_000 + "}",
        '{"type": "ping", "t": ' + "9" * 400 + "}",
    ],
)
def test_what_is_not_documented_is_refused(text: str) -> None:
    with pytest.raises(protocol.ProtocolError):
        protocol.parse(text)


def test_numbers_out_of_range_are_clipped() -> None:
    parsed = protocol.parse(message(walk=[9, -9, 0.5], lift=-7))
    assert isinstance(parsed, protocol.Input)
    np.testing.assert_array_equal(parsed.controls.walk, [1.0, -1.0, 0.5])
    assert parsed.controls.lift == -1.0 and parsed.controls.heading is None


@given(content=JSON)
def test_whatever_comes_is_understood_or_refused(content: object) -> None:
    for text in (json.dumps(content), json.dumps({"type": "input", "hands": content, "head": content})):
        try:
            protocol.parse(text)
        except protocol.ProtocolError:
            continue
