"""``demohlm record``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gym_demohlm.errors import DemonstrationError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``demohlm record``.

    Attributes:
        task: Name of the task, such as LiftBox.
        teleop: Who operates: the task's script, or a person at a web page with headset, phone, gamepad or keyboard.
        host: Where to serve the page; https for names other than localhost.
        port: Where to serve the page; 0 for any that is free.
        scale: Metres that a palm moves for a metre of the person's hand.
        operator: Who records at the page; written into the demonstration.
        trial: Attempts generated from a recording at the page before it is saved; 0 for none.
        controller: Name of a controller, path of its weights, or the first eight or more digits of their hash.
        root: Directory to write; must not exist.
    """

    task: str
    teleop: Literal["scripted", "web"] = "scripted"
    host: str = "localhost"
    port: int = 8012
    scale: float = 1.0
    operator: str = "person"
    trial: int = 20
    controller: str = "default"
    root: Path


def run(options: Options) -> None:
    """Record a demonstration with the task's scripted operator, or with a person at a page.

    Raises:
        DemonstrationError: The root exists, a number is out of range, or nothing was saved.
    """
    from gym_demohlm.registry import get_task

    task = get_task(options.task)
    if not 0 <= options.port <= 65535 or not 0.1 <= options.scale <= 10.0 or options.trial < 0:
        raise DemonstrationError(
            f"port={options.port}, scale={options.scale:g}, trial={options.trial}",
            "a port of 0 to 65535, a scale of 0.1 to 10 and 0 or more attempts",
            "correct them",
        )
    if options.root.exists():
        raise DemonstrationError(f"the root {options.root}, which exists", "a new path", "choose another --root")
    if options.teleop == "web":
        from lerobot_demohlm.teleop.session import SessionSettings
        from lerobot_demohlm.teleop.web.record import WebSettings, record_in_browser, trial_settings

        session = SessionSettings(
            scale=options.scale,
            operator=options.operator,
            trial=trial_settings(options.trial),
            controller=options.controller,
        )
        settings = WebSettings(host=options.host, port=options.port, session=session)
        ticks, name = record_in_browser(task, options.root, settings), options.operator
    else:
        from lerobot_demohlm.teleop.record import record, script_of

        script = script_of(task)
        demonstration = record(task, script.make_operator(), script.start, controller=options.controller)
        demonstration.save(options.root, task)
        ticks, name = len(demonstration), str(demonstration.metadata["operator"])
    print(f"{options.root}: {ticks} ticks by {name}")
