"""An operator and a task -> a demonstration: poses at 10 Hz, inverse kinematics, commands, controller, physics."""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass

from gym_demohlm.errors import DemonstrationError, UnknownNameError
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from lerobot_demohlm.demonstrations.demonstration import Demonstration, require_contact
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
    name = f"{scripts.__name__}.{task.slug}"
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        available = [*(entry.name for entry in pkgutil.iter_modules(scripts.__path__)), *_registered]
        raise UnknownNameError("scripted operator", task.slug, available) from None
    return Script(start=module.START, make_operator=module.make_operator)


def record(
    task: Task,
    operator: Operator,
    start: InitialState | None = None,
    frame: Callable[[Simulation], None] | None = None,
    controller: str | None = None,
) -> Demonstration:
    """Let an operator do a task and return the recording.

    Args:
        task: The task.
        operator: Gives head and palm poses.
        start: Where robot and objects are when the operator takes over; the task's default state if not given.
        frame: Called with the simulation before every command, for pictures.
        controller: Name, path or hash of the whole-body controller; the default one by default.

    Raises:
        UnknownNameError: No such controller.
        DemonstrationError: The robot did not get to the operator's place, the task did not succeed, or no hand
            touched anything.
    """
    sim = Simulation(task, controller=controller)
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
