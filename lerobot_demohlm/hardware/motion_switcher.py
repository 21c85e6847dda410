"""Requests to the robot's motion switcher: which controller of its own runs, and to stop it.

While one runs, it writes ``rt/lowcmd`` too, and two controllers would fight over the motors. Once released, the robot
is limp: it must hang in its gantry.
"""

import json
import time
from typing import Any

from lerobot_demohlm.hardware import idl
from lerobot_demohlm.hardware.errors import RobotError
from lerobot_demohlm.hardware.link import REQUESTS, RESPONSES, Link

CHECK, RELEASE = 1001, 1003
_AGAIN_S = 0.5  # a request that nobody was there to hear is sent again


class MotionSwitcher:
    """The side that asks.

    Args:
        link: The network.
        timeout_s: How long to wait for an answer [s].
    """

    def __init__(self, link: Link, timeout_s: float = 5.0) -> None:
        self._requests, self._responses = link.writer(REQUESTS, newest=False), link.reader(RESPONSES, newest=False)
        self._timeout_s = timeout_s
        self._number = time.monotonic_ns()

    def check(self) -> str:
        """Return the name of the robot's own controller that runs, such as "ai"; empty where none does.

        Raises:
            RobotError: The robot does not answer, or refuses.
        """
        return str(json.loads(self._ask(CHECK).data or "{}").get("name", ""))

    def release(self) -> None:
        """Stop the robot's own controller; it goes limp.

        Raises:
            RobotError: The robot does not answer, refuses, or its controller still runs.
        """
        self._ask(RELEASE)
        remaining = self.check()
        if remaining:
            raise RobotError(f"the robot's controller {remaining!r} still at work", "none", "release it again")

    def _ask(self, api: int) -> Any:  # noqa: ANN401
        until, again, self._number = time.monotonic() + self._timeout_s, 0.0, self._number + 1
        identity = idl.RequestIdentity_(self._number, api)
        header = idl.RequestHeader_(identity, idl.RequestLease_(0), idl.RequestPolicy_(0, False))
        request = idl.Request_(header, "", [])  # pyright: ignore[reportArgumentType]
        while (now := time.monotonic()) < until:
            if now >= again:
                self._requests.send_message(request)
                again = now + _AGAIN_S
            for answer in self._responses.take():
                if answer.header.identity.id != self._number:
                    continue
                if answer.header.status.code != 0:
                    raise RobotError(
                        f"code {answer.header.status.code} of the motion switcher",
                        "0",
                        "look at the robot's remote: its mode may forbid it",
                    )
                return answer
            time.sleep(0.005)
        raise RobotError(
            f"no answer of the motion switcher within {self._timeout_s:g} s",
            "a robot on this interface",
            "check cable and address, and that the robot is on",
        )


def refuse_own_controller(interface: str, domain: int) -> None:
    """Ask a robot whether a controller of its own runs.

    Args:
        interface: Of the network.
        domain: Of DDS.

    Raises:
        RobotError: One does, or the robot does not answer.
    """
    name = MotionSwitcher(Link(interface, domain)).check()
    if name:
        raise RobotError(
            f"the robot's own controller {name!r}",
            "none at work",
            "hang the robot in its gantry and release it with `demohlm deploy --release`",
        )


class MotionSwitcherService:
    """The side that answers, for a simulated robot.

    Args:
        link: The network.
        name: Of the controller that runs.

    Attributes:
        name: Of the controller that runs; empty once released.
    """

    def __init__(self, link: Link, name: str = "") -> None:
        self.name = name
        self._requests, self._responses = link.reader(REQUESTS, newest=False), link.writer(RESPONSES, newest=False)

    def serve(self) -> None:
        """Answer what has been asked since the last call."""
        for request in self._requests.take():
            identity = request.header.identity
            known = identity.api_id in (CHECK, RELEASE)
            if identity.api_id == RELEASE:
                self.name = ""
            data = json.dumps({"form": "0", "name": self.name}) if identity.api_id == CHECK else ""
            header = idl.ResponseHeader_(identity, idl.ResponseStatus_(0 if known else 3203))
            self._responses.send_message(idl.Response_(header, data, []))  # pyright: ignore[reportArgumentType]
