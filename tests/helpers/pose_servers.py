"""Pose servers in threads: the reference one, and ones that do what servers should not."""

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import zmq

from gym_demohlm.perception import wire
from gym_demohlm.perception.pose_server import Backend, serve

Reply = Callable[[wire.Request], bytes | None]
"""What a server answers; nothing where it is None."""


@contextlib.contextmanager
def serving(backend: Backend) -> Iterator[str]:
    """Serve in a thread; gives the address."""
    found: list[str] = []
    ready, stopped = threading.Event(), threading.Event()

    def noted(address: str) -> None:
        found.append(address)
        ready.set()

    thread = threading.Thread(target=serve, args=(backend, "tcp://127.0.0.1:*", noted, stopped.is_set))
    thread.start()
    try:
        assert ready.wait(20)
        yield found[0]
    finally:
        stopped.set()
        thread.join()


@contextlib.contextmanager
def replying(reply: Reply) -> Iterator[str]:
    """Answer every request by a function, or not at all; gives the address."""
    context = zmq.Context()
    socket = context.socket(zmq.ROUTER)
    socket.linger = 0
    socket.bind("tcp://127.0.0.1:*")
    stopped = threading.Event()

    def run() -> None:
        while not stopped.is_set():
            if socket.poll(20):
                identity, empty, *parts = socket.recv_multipart()
                answer = reply(wire.unpack_request(parts))
                if answer is not None:
                    socket.send_multipart([identity, empty, answer])

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield socket.getsockopt_string(zmq.LAST_ENDPOINT)
    finally:
        stopped.set()
        thread.join()
        context.destroy(linger=0)


def told(request: wire.Request, *, change: Callable[[dict], None] = lambda answer: None, wait_s: float = 0.0) -> bytes:
    """Return an answer that has each object 1 m before the lens, after a change and a wait."""
    T = np.eye(4)
    T[2, 3] = 1.0
    good = [wire.Answer(T_optical_object=T, valid=True)] * len(request.objects)
    answer = json.loads(wire.pack_answers(request.frame, good, 1.0))
    change(answer)
    time.sleep(wait_s)
    return json.dumps(answer).encode()
