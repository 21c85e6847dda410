"""Real DDS over loopback: topics, services, and that nothing leaves the named interface."""

import multiprocessing
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_demohlm.hardware.control_process import refuse_other_robots
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.layout import LowCmd, LowState
from lerobot_demohlm.hardware.link import LOW_CMD, LOW_STATE, Link, check_interface, configuration
from lerobot_demohlm.hardware.motion_switcher import MotionSwitcher
from tests.helpers import domains
from tests.helpers.domains import free_domain
from tests.helpers.own_controller import own_controller
from tests.helpers.paths import REPOSITORY
from tests.helpers.robot import until

SPDP_GROUP = "0100FFEF"  # 239.255.0.1, to which DDS announces itself, as /proc/net/igmp writes it


def groups() -> dict[str, set[str]]:
    """Return the multicast groups that each interface of this machine has joined."""
    joined: dict[str, set[str]] = {}
    device = ""
    for line in Path("/proc/net/igmp").read_text().splitlines()[1:]:
        head = re.match(r"\d+\s+(\S+)", line)
        if head:
            device = head[1]
        else:
            joined.setdefault(device, set()).add(line.split()[0])
    return joined


def _echo(domain: int) -> None:
    with Link("lo", domain) as link:
        reader, writer = link.reader(LOW_CMD), link.writer(LOW_STATE)
        state = LowState()
        while True:
            content = reader.newest()
            if content is not None:
                command = LowCmd(content)
                state.tick, state.mode_machine = int(command.q[0]), command.is_sound()
                state.seal()
                writer.send(state.to_bytes())
            time.sleep(0.001)


def test_messages_go_to_another_process_and_back(link: Link) -> None:
    other = multiprocessing.get_context("spawn").Process(target=_echo, args=(link.domain,), daemon=True)
    other.start()
    try:
        reader, writer, command = link.reader(LOW_STATE), link._writer(LOW_CMD), LowCmd()
        for number in (7, 11):
            command.q[0] = number
            command.seal()

            def answered(number: int = number) -> bool:
                writer.send(command.to_bytes())
                content = reader.newest()
                return content is not None and LowState(content).is_sound() and LowState(content).tick == number

            until(answered, 120.0)  # the other process has much to import first
        assert reader.writers() == 1
    finally:
        other.kill()


def test_who_leaves_the_network_is_gone(link: Link) -> None:
    """Also where somebody still has its readers and writers."""
    reader, writer = link.reader(LOW_STATE), link._writer(LOW_CMD)
    with Link("lo", link.domain) as other:
        kept = other.writer(LOW_STATE), other.reader(LOW_CMD)
        until(lambda: (reader.writers(), writer.readers()) == (1, 1), 20.0)
    until(lambda: (reader.writers(), writer.readers()) == (0, 0), 5.0)
    assert len(kept) == 2


def test_no_domain_is_given_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither by one process nor by two at once; one of a process that has ended is free again."""
    first = 1000 + 2 * os.getpid()  # numbers that no other test has
    code = f"from tests.helpers import domains; domains.DOMAINS = range({first}, {first + 2})"
    call = [sys.executable, "-c", code + "; print(domains.free_domain(), flush=True); input()"]
    monkeypatch.setattr(domains, "DOMAINS", range(first, first + 2))
    with subprocess.Popen(call, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        theirs = int(other.stdout.readline())
        assert {theirs, free_domain()} == {first, first + 1}
        with pytest.raises(AssertionError, match="is free"):
            free_domain()
        other.communicate("\n")
    assert free_domain() == theirs


def test_two_robots_on_one_network_are_refused(link: Link) -> None:
    states, first = link.reader(LOW_STATE), link.writer(LOW_STATE)
    until(lambda: states.writers() == 1, 20.0)
    refuse_other_robots(states, "lo")
    second = link.writer(LOW_STATE)
    until(lambda: states.writers() == 2, 20.0)
    with pytest.raises(RobotError, match="2 robots on lo; expected one"):
        refuse_other_robots(states, "lo")
    assert first is not second


def test_only_the_named_interface_is_joined(link: Link) -> None:
    link._writer(LOW_CMD)
    joined = groups()
    assert SPDP_GROUP in joined["lo"]
    assert all(SPDP_GROUP not in there for name, there in joined.items() if name != "lo")


def test_the_environment_cannot_add_an_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><General><Interfaces><NetworkInterface "
                       "autodetermine='true'/></Interfaces></General></Domain></CycloneDDS>")  # fmt: skip
    with Link("lo", free_domain()) as link:
        link._writer(LOW_CMD)
        joined = groups()
    assert SPDP_GROUP in joined["lo"]
    assert all(SPDP_GROUP not in there for name, there in joined.items() if name != "lo")
    assert configuration("lo").count("<NetworkInterface") == 1


def test_an_interface_that_is_not_there_is_refused() -> None:
    with pytest.raises(RobotError, match=r"no interface 'nowhere0'; expected one of .*lo.*--interface"):
        check_interface("nowhere0")


def test_a_process_keeps_to_one_interface(link: Link) -> None:
    from socket import if_nameindex

    others = [name for _, name in if_nameindex() if name != "lo"]
    if not others:
        pytest.skip("this machine has no other interface")
    with pytest.raises(RobotError, match=r"one interface a process|is down"):
        Link(others[0], link.domain)


def test_the_robots_own_controller_is_found_and_released(link: Link) -> None:
    with own_controller(link.domain):
        switcher = MotionSwitcher(link)
        assert switcher.check() == "ai"
        switcher.release()
        assert switcher.check() == ""
        with pytest.raises(RobotError, match="code 3203"):
            switcher._ask(1002)


def test_a_robot_that_does_not_answer_is_an_error(link: Link) -> None:
    with pytest.raises(RobotError, match="no answer of the motion switcher"):
        MotionSwitcher(link, timeout_s=0.3).check()
