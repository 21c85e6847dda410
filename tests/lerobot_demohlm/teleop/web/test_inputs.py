"""Who drives, and how long a message takes to a command."""

import pytest

from lerobot_demohlm.teleop.clutch import Controls
from lerobot_demohlm.teleop.web import protocol
from lerobot_demohlm.teleop.web.inputs import Inputs, Latencies

WALK = '{"type": "input", "walk": [1, 0, 0]}'


def test_one_browser_drives_until_it_rests() -> None:
    now = [0.0]
    inputs = Inputs(lambda: now[0])
    walking, standing = protocol.parse(WALK), protocol.parse('{"type": "input"}')
    assert isinstance(walking, protocol.Input) and isinstance(standing, protocol.Input)
    assert inputs.latest().age_s > 1e5
    assert inputs.put("a", walking)
    first = inputs.latest().driver
    assert not inputs.put("b", walking)
    assert inputs.put("a", walking) and inputs.latest().driver == first
    now[0] = 1.0
    assert inputs.put("a", standing)
    assert not inputs.put("b", standing)
    assert inputs.put("b", walking)
    assert inputs.latest().driver != first, "another person's hands are elsewhere"
    assert not inputs.put("a", walking)
    inputs.gone("b")
    assert not inputs.latest().walk.any() and isinstance(inputs.latest(), Controls)


def test_latencies_count_every_message_up_to_its_command() -> None:
    latencies = Latencies()
    for sent in (1.00, 1.02, 1.08):
        latencies.arrived(sent)
    latencies.taken()
    latencies.arrived(1.09)  # too late for this command
    latencies.applied(1.1)
    assert latencies.summary() == {"count": 3, "p50_ms": 80.0, "p99_ms": pytest.approx(99.6)}


def test_messages_of_a_pause_are_no_latencies() -> None:
    latencies = Latencies()
    for sent in range(100):  # nothing becomes a command meanwhile
        latencies.arrived(float(sent))
        latencies.taken()
    latencies.applied(99.02)
    assert latencies.summary() == {"count": 1, "p50_ms": pytest.approx(20.0), "p99_ms": pytest.approx(20.0)}
