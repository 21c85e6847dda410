"""A task and a person's browser -> a demonstration: what ``demohlm record --teleop web`` does."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gym_demohlm.errors import DemonstrationError, UnknownNameError
from gym_demohlm.task import InitialState, Task
from lerobot_demohlm.teleop.record import script_of
from lerobot_demohlm.teleop.session import RecordingSession, SessionSettings
from lerobot_demohlm.teleop.status import SAVED
from lerobot_demohlm.teleop.trial import TrialSettings
from lerobot_demohlm.teleop.web.server import TeleopServer, require_port

SWITCH_S = 0.001  # the world's thread and that of the browsers take turns this often


@dataclass(frozen=True, kw_only=True)
class WebSettings:
    """How a page is served.

    Attributes:
        host: Where to listen; names other than of this machine alone get https.
        port: Where to listen; 0 for any that is free.
        session: How the recording works.
    """

    host: str = "localhost"
    port: int = 8012
    session: SessionSettings = field(default_factory=SessionSettings)


def operators_place(task: Task, seed: int | None = None, region: str = "R1", spread: float = 1.0) -> InitialState:
    """Return where robot and objects are when a person takes over.

    Args:
        task: The task.
        seed: Of objects moved by a region's offsets; None leaves them where they are by default.
        region: The region.
        spread: Share of the region's offsets, of each object; the robot's place does not follow them.
    """
    try:
        start = script_of(task).start
    except UnknownNameError:
        start = task.default_state()
    if seed is None:
        return start
    drawn = task.sample(region, np.random.default_rng([3, seed]))
    offsets = {name: values for name, values in drawn.items() if name != "robot"}
    return start | {name: [spread * value for value in values] for name, values in offsets.items()}


def record_in_browser(task: Task, root: Path, settings: WebSettings | None = None) -> int:
    """Serve the page until a demonstration is saved; returns the number of its steps.

    The address is printed as one line of JSON.

    Raises:
        DemonstrationError: The root exists, nobody can listen at the port, or nothing was saved.
    """
    settings = settings or WebSettings()
    require_port(settings.host, settings.port)
    session = RecordingSession(task, root, operators_place(task), settings=settings.session)
    sys.setswitchinterval(SWITCH_S)
    server = TeleopServer(session, settings.host, settings.port, lambda line: print(line, flush=True))
    try:
        server.run()
    except KeyboardInterrupt:
        print("stopped; a recording under way can be taken up by the same command", file=sys.stderr)
    finally:
        session.close()
    saved = session.recorded
    if session.state != SAVED or saved is None:
        raise DemonstrationError("no demonstration", "one that was saved", "record one and press save")
    print(json.dumps({"event": "saved", "root": str(root)}), flush=True)
    return len(saved)


def trial_settings(attempts: int) -> TrialSettings | None:
    """Return the settings of a trial of so many attempts; None for none."""
    return TrialSettings(attempts=attempts) if attempts > 0 else None
