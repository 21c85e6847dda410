"""A robot whose own controller runs: it answers who asks which one does, and stops it where asked to."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from lerobot_demohlm.hardware.link import Link
from lerobot_demohlm.hardware.motion_switcher import MotionSwitcherService


@contextmanager
def own_controller(domain: int) -> Iterator[MotionSwitcherService]:
    """Answer in a DDS domain of ``lo``; the controller's name is "ai" until it is released."""
    stop = threading.Event()
    with Link("lo", domain) as link:
        service = MotionSwitcherService(link, "ai")

        def serve() -> None:
            while not stop.wait(0.005):
                service.serve()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield service
        finally:
            stop.set()
            thread.join()
