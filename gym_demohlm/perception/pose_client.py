"""Pictures of one camera -> a pose server elsewhere -> answers, without ever waiting for them longer than allowed.

The client asks for nothing new while it waits for an answer. An answer that comes late is handed on with the number of
its picture. What cannot be used is counted, with its reason.
"""

import time
from collections import Counter
from dataclasses import dataclass, replace

import zmq

from gym_demohlm.perception import wire

NO_ANSWER = "no answer in time"
LATE = "an answer that came late"
_LOST = "an object that the server has lost"
GIVEN_UP_S = 2.0  # after which a server that has not answered is called anew, once the wait for it is over
_GLANCE_MS = 20  # how long an answer is waited for that was late already


@dataclass(frozen=True, kw_only=True)
class Told:
    """What a server has said.

    Attributes:
        request: The picture that it has looked at.
        late: How many pictures ago that was.
        answers: One an object.
    """

    request: wire.Request
    late: int
    answers: list[wire.Answer]


class PoseClient:
    """Asks a server about the pictures of one camera, in their order.

    Args:
        context: Of ZMQ.
        address: Of the server.
        timeout_s: Longest wait for an answer [s].

    Attributes:
        faults: How often what went wrong.
    """

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", address: str, timeout_s: float) -> None:
        self._context, self._address, self._timeout_ms = context, address, round(1e3 * timeout_s)
        self._socket: zmq.Socket[bytes] | None = None
        self._asked: wire.Request | None = None
        self._asked_s = 0.0  # when, by ``time.monotonic``
        self._unsent_s = 0.0  # since the last picture that was sent
        self.faults: Counter[str] = Counter()

    def look(self, request: wire.Request) -> Told | None:
        """Show the next picture, and return what the server says of it or of an earlier one; None where it is silent.

        Args:
            request: Its ``frame`` is one more than the last one's, and its ``dt_s`` the time since that one. The
                server gets the time since the last picture that was sent instead.
        """
        wait_ms = self._timeout_ms
        self._unsent_s += request.dt_s
        if self._asked is None:
            self._asked = replace(request, dt_s=self._unsent_s)
            self._unsent_s = 0.0
            self._called().send_multipart([b"", *wire.pack_request(self._asked)])
            self._asked_s = time.monotonic()
        else:
            wait_ms = min(wait_ms, _GLANCE_MS)
        return self._heard(request.frame, wait_ms)

    @property
    def asked(self) -> int | None:
        """Number of the picture whose answer is waited for; None where none is."""
        return None if self._asked is None else self._asked.frame

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            self._socket.close()
        self._socket = self._asked = None

    def _called(self) -> "zmq.Socket[bytes]":
        if self._socket is None:
            socket = self._context.socket(zmq.DEALER)
            socket.linger = 0
            socket.connect(self._address)
            self._socket = socket
        return self._socket

    def _heard(self, frame: int, wait_ms: int) -> Told | None:
        """Take what the server has said; note what is wrong with it, or that it has said nothing."""
        asked, socket = self._asked, self._called()
        assert asked is not None
        if not socket.poll(wait_ms):
            self.faults[NO_ANSWER] += 1
            if time.monotonic() - self._asked_s > max(GIVEN_UP_S, 2e-3 * self._timeout_ms):
                self.close()
            return None
        message = socket.recv_multipart()[-1]
        self._asked = None
        try:
            answered, answers = wire.unpack_answers(message, len(asked.objects))
            if answered != asked.frame:
                raise ValueError("an answer to another picture")
        except ValueError as error:
            self.faults[str(error)] += 1
            return None
        late = frame - asked.frame
        self.faults.update([LATE] if late else [])
        self.faults.update([answer.reason or _LOST for answer in answers if not answer.valid])
        return Told(request=asked, late=late, answers=answers)
