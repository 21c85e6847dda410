"""An operator and a task -> a demonstration: poses at 10 Hz, inverse kinematics, commands, controller, physics."""

import argparse
import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gym_demohlm.errors import DemonstrationError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration, require_contact
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.teleop import scripts
from lerobot_demohlm.teleop.operator import Operator
from lerobot_demohlm.teleop.recorder import Recorder, take_over

MAX_TICKS = 600


@dataclass(frozen=True, kw_only=True)
class Script:
    """A scripted operator of one task.

    Attributes:
        start: Where robot and objects are when the operator takes over.
        make_operator: Returns a new one, which has not moved yet.
    """

    start: InitialState
    make_operator: Callable[[], Operator]


_registered: dict[str, Script] = {}


def register_script(task: Task, script: Script) -> None:
    """Give a task its scripted operator; those of the tasks in the package are found in ``scripts/``.

    Raises:
        DemonstrationError: The task has another one.
    """
    if _registered.setdefault(task.name, script) != script:
        raise DemonstrationError(f"a second script of {task.name}", "one script a task", "register one of the two")


def script_of(task: Task) -> Script:
    """Return a task's scripted operator.

    Raises:
        UnknownNameError: The task has none.
    """
    if task.name in _registered:
        return _registered[task.name]
    name = f"{scripts.__name__}.{provenance.file_name(task)}"
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        available = [*(entry.name for entry in pkgutil.iter_modules(scripts.__path__)), *_registered]
        raise UnknownNameError("scripted operator", provenance.file_name(task), available) from None
    return Script(start=module.START, make_operator=module.make_operator)


def record(
    task: Task,
    operator: Operator,
    start: InitialState | None = None,
    frame: Callable[[Simulation], None] | None = None,
) -> Demonstration:
    """Let an operator do a task and return the recording.

    Args:
        task: The task.
        operator: Gives head and palm poses.
        start: Where robot and objects are when the operator takes over; the task's default state if not given.
        frame: Called with the simulation before every command, for pictures.

    Raises:
        DemonstrationError: The task did not succeed, or no hand touched anything.
        OffCourseError: The robot did not get to the operator's place.
    """
    sim = Simulation(task)
    start = start or task.default_state()
    take_over(sim, start)
    recorder = Recorder(sim)
    recorder.begin()
    for _ in range(MAX_TICKS):
        asked = operator.poses(recorder.view())
        if asked is None:
            break
        if frame is not None:
            frame(sim)
        recorder.step(asked)
    demonstration = recorder.demonstration(operator.name, start)
    sim.close()
    require_contact(demonstration)
    if not demonstration.success[-10:].all():
        raise DemonstrationError(
            f"a recording of {task.name} that holds success for {int(demonstration.success.sum())} ticks",
            "success at the end, held for 1 s",
            "record it again",
        )
    return demonstration


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm record``."""
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument(
        "--teleop",
        choices=("scripted", "web"),
        default="scripted",
        help="who operates: the task's script, or a person at a page that is served (default: %(default)s)",
    )
    parser.add_argument("--host", default="localhost", help="web: where to listen; others than this machine get https")
    parser.add_argument("--port", type=int, default=8012, help="web: where to listen, 0 for any (default: %(default)s)")
    parser.add_argument("--scale", type=float, default=1.0, help="web: metres of a palm for a metre of a hand")
    parser.add_argument("--operator", default="person", help="web: who records, written into the demonstration")
    parser.add_argument(
        "--trial", type=int, default=20, help="web: attempts generated before saving (default: %(default)s)"
    )
    parser.add_argument("--root", type=Path, required=True, help="directory to write; must not exist")


def main(arguments: argparse.Namespace) -> None:
    """Record a demonstration with the task's scripted operator, or with a person at a page."""
    task = get_task(arguments.task)
    if arguments.teleop == "web":
        from lerobot_demohlm.teleop.session import SessionSettings
        from lerobot_demohlm.teleop.web.record import WebSettings, record_in_browser, trial_settings

        session = SessionSettings(
            scale=arguments.scale, operator=arguments.operator, trial=trial_settings(arguments.trial)
        )
        settings = WebSettings(host=arguments.host, port=arguments.port, session=session)
        num_ticks = record_in_browser(task, arguments.root, settings)
        print(f"{arguments.root}: {num_ticks} ticks by {arguments.operator}")
        return
    if arguments.root.exists():
        raise DemonstrationError(f"the root {arguments.root}, which exists", "a new path", "choose another --root")
    script = script_of(task)
    demonstration = record(task, script.make_operator(), script.start)
    demonstration.save(arguments.root)
    print(f"{arguments.root}: {len(demonstration)} ticks by {demonstration.metadata['operator']}")
