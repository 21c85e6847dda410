"""A named network interface -> readers and writers of the robot's topics on it, and on no other.

CycloneDDS gets a configuration with that one interface; what the environment says (``CYCLONEDDS_URI``) is not read.
"""

import socket
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from weakref import WeakSet

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from lerobot_demohlm.hardware import idl
from lerobot_demohlm.hardware.errors import RobotError

LOW_CMD, LOW_STATE = "rt/lowcmd", "rt/lowstate"
REQUESTS, RESPONSES = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
WORLD = "rt/demohlm/world"
DOMAIN = 0  # the robot's
_TYPES: dict[str, Any] = {
    LOW_CMD: idl.LowCmd_,
    LOW_STATE: idl.LowState_,
    REQUESTS: idl.Request_,
    RESPONSES: idl.Response_,
    WORLD: idl.World_,
}
_NEWEST = Qos(Policy.History.KeepLast(1), Policy.Reliability.BestEffort)
_EVERY = Qos(Policy.History.KeepLast(16), Policy.Reliability.Reliable(duration(seconds=1)))
_CONFIGURATION = """<CycloneDDS><Domain Id="any"><General><Interfaces>
<NetworkInterface name="{name}" priority="default" multicast="{multicast}"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>{peers}
</Discovery><Tracing><Verbosity>severe</Verbosity><OutputFile>/dev/null</OutputFile></Tracing></Domain></CycloneDDS>"""

_domains: dict[int, tuple[str, Domain]] = {}


def check_interface(name: str) -> str:
    """Return the name of a network interface of this machine.

    Raises:
        RobotError: There is no such interface, or it is down.
    """
    names = [interface for _, interface in socket.if_nameindex()]
    if name not in names:
        raise RobotError(f"no interface {name!r}", f"one of {', '.join(names)}", "name it with --interface")
    try:
        up = int(Path(f"/sys/class/net/{name}/flags").read_text(), 16) & 1
    except OSError:
        up = 1
    if not up:
        raise RobotError(f"the interface {name}, which is down", "one that is up", f"ip link set {name} up")
    return name


class Link:
    """A participant on one interface.

    Args:
        interface: Name of the network interface, such as lo or enp2s0.
        domain: Of DDS; the robot's is 0.

    Attributes:
        interface: Its name.
        domain: Of DDS.

    Raises:
        RobotError: There is no such interface, this process already uses the domain on another one, or the network may
            not be used.
    """

    def __init__(self, interface: str, domain: int = DOMAIN) -> None:
        self.interface, self.domain = check_interface(interface), domain
        self._ends: WeakSet[Reader | Writer] = WeakSet()
        used = _domains.get(domain)
        if used is not None and used[0] != interface:
            raise RobotError(f"the interface {interface} after {used[0]}", "one interface a process", "start another")
        try:
            if used is None:
                _domains[domain] = interface, Domain(domain, configuration(interface))
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            _domains.pop(domain, None)
            raise RobotError(
                f"no DDS on {interface} ({error})", "an interface with an address that may be used",
                "give it an address, or ask for the permission to open sockets",
            ) from error  # fmt: skip

    def reader(self, topic: str, newest: bool = True) -> "Reader":
        """Return a reader of a topic; of the newest message alone, or of every one."""
        made = Topic(self._participant, topic, _TYPES[topic])
        reader = Reader(DataReader(self._participant, made, _NEWEST if newest else _EVERY))
        self._ends.add(reader)
        return reader

    def writer(self, topic: str, newest: bool = True) -> "Writer":
        """Return a writer of a topic.

        Raises:
            RobotError: Commands to motors are asked for: they go through ``wire.CommandWire`` alone.
        """
        if topic == LOW_CMD:
            raise RobotError("a writer of commands to motors", "CommandWire, which filters them", "send through it")
        return self._writer(topic, newest)

    def _writer(self, topic: str, newest: bool = True) -> "Writer":
        made = Topic(self._participant, topic, _TYPES[topic])
        reliable = Qos(Policy.History.KeepLast(1), Policy.Reliability.Reliable(duration(milliseconds=0)))
        writer = Writer(DataWriter(self._participant, made, reliable if newest else _EVERY), _TYPES[topic])
        self._ends.add(writer)
        return writer

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the network."""
        self.close()

    def close(self) -> None:
        """Leave the network; readers and writers are of no use any more."""
        for end in self._ends:
            end.close()  # each holds the participant
        del self._participant


class Reader:
    """Takes what has arrived; never waits."""

    def __init__(self, reader: DataReader) -> None:
        self._reader = reader

    def close(self) -> None:
        """End it."""
        del self._reader

    def take(self, most: int = 32) -> list[Any]:
        """Return the messages that have arrived since the last call, oldest first."""
        return [sample for sample in self._reader.take(most) if sample.sample_info.valid_data]

    def newest(self) -> bytes | None:
        """Return the bytes of the newest message since the last call; None where none has come."""
        taken = self.take()
        return taken[-1].content if taken else None

    def writers(self) -> int:
        """Return how many writers of the topic are known."""
        return len(self._reader.get_matched_publications())


class Writer:
    """Sends messages."""

    def __init__(self, writer: DataWriter, kind: Any) -> None:  # noqa: ANN401
        self._writer, self._kind = writer, kind

    def close(self) -> None:
        """End it."""
        del self._writer

    def send(self, content: bytes) -> None:
        """Send the bytes of a message of fixed layout."""
        self._writer.write(self._kind.carrying(content))

    def send_message(self, message: Any) -> None:  # noqa: ANN401
        """Send a message of a service."""
        self._writer.write(message)

    def readers(self) -> int:
        """Return how many readers of the topic are known."""
        return len(self._writer.get_matched_subscriptions())


def configuration(interface: str) -> str:
    """Return CycloneDDS's configuration for one interface alone."""
    local = interface == "lo"
    peers = '<Peers><Peer address="127.0.0.1"/></Peers>' if local else ""
    return _CONFIGURATION.format(name=interface, multicast="default", peers=peers)
