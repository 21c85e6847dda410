"""An operator and a task -> a demonstration: poses at 10 Hz, inverse kinematics, commands, controller, physics."""

import argparse
import importlib
import pkgutil
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.control.ik import WholeBodyIK
from gym_demohlm.errors import DemonstrationError, UnknownNameError
from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import InitialState, Task
from lerobot_demohlm.datasets.facts import installed_versions
from lerobot_demohlm.demonstrations.demonstration import (
    ARRAYS,
    FORMAT_VERSION,
    Demonstration,
    measure,
    pose_numbers,
    require_contact,
)
from lerobot_demohlm.generation.locomotion import LocomotionSettings, walk
from lerobot_demohlm.reproducibility import provenance
from lerobot_demohlm.teleop import scripts
from lerobot_demohlm.teleop.operator import Operator, SceneView

APPROACH = 0.3  # m that the robot walks to where the operator takes over: so it stands as one that has walked
EXACT = LocomotionSettings(accept_m=0.035, accept_rad=0.08, max_walks=20, max_ticks=600)
SETTLE_TICKS = 10  # it stands still before
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
    model_hash = provenance.model_hash(sim.model)
    start = start or task.default_state()
    stance = np.array(start["robot"])
    behind = poses.to_planar(poses.planar(*stance) @ poses.planar(-APPROACH, 0.0, 0.0))
    sim.reset([start | {"robot": behind.tolist()}])
    ik = WholeBodyIK(sim.model)
    for wanted in walk(lambda: sim.pose("pelvis")[0], stance, EXACT):
        sim.step(wanted[None])
    for _ in range(SETTLE_TICKS):
        sim.step(command.rest()[None])
    snapshot = sim.snapshot()
    rows: list[dict[str, np.ndarray]] = []
    last = command.rest()
    for tick in range(MAX_TICKS):
        asked = operator.poses(_view(sim, tick))
        if asked is None:
            break
        if frame is not None:
            frame(sim)
        solution = ik.solve(
            T_world_pelvis=sim.pose("pelvis")[0],
            joint_positions=sim.joint_positions[0],
            T_world_left=asked.T_world_hands[0],
            T_world_right=asked.T_world_hands[1],
            T_world_head=asked.T_world_head,
            previous=last,
        )
        last = solution.command.copy()
        last[command.GRIPPERS] = asked.grippers
        last[command.VELOCITY] = asked.velocity
        last = last.astype(np.float32).astype(np.float64)  # what is recorded is what was applied
        row = measure(sim) | {"action": last.astype(np.float32), "hand_targets": pose_numbers(asked.T_world_hands)}
        result = sim.step(last[None])
        row["contact_forces"] = result.contact_forces[0].mean(axis=0)
        row["success"] = sim.success()[0]
        rows.append(row)
    end = sim.snapshot()
    demonstration = Demonstration(
        task=task.name,
        start=snapshot,
        end=end,
        metadata={
            "format_version": FORMAT_VERSION,
            "task": task.name,
            "operator": operator.name,
            "stance": start,
            "controller_hash": provenance.controller_hash(),
            "model_hash": model_hash,
            "versions": installed_versions(),
            "processor": platform.machine(),
        },
        **{name: np.stack([row[name] for row in rows]) for name in ARRAYS},  # pyright: ignore[reportArgumentType]
    )
    sim.close()
    require_contact(demonstration)
    if not demonstration.success[-10:].all():
        raise DemonstrationError(
            f"a recording of {task.name} that holds success for {int(demonstration.success.sum())} ticks",
            "success at the end, held for 1 s",
            "record it again",
        )
    return demonstration


def _view(sim: Simulation, tick: int) -> SceneView:
    return SceneView(
        tick=tick,
        T_world_head=sim.pose("head_camera")[0],
        T_world_pelvis=sim.pose("pelvis")[0],
        T_world_hands=np.stack([sim.pose(f"{side}_palm")[0] for side in g1.SIDES]),
        T_world_objects={entry.name: sim.pose(entry.name)[0] for entry in sim.task.objects},
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``demohlm record``."""
    parser.add_argument("--task", required=True, help="name of the task, such as LiftBox")
    parser.add_argument(
        "--teleop", choices=("scripted",), default="scripted", help="who operates (default: %(default)s)"
    )
    parser.add_argument("--root", type=Path, required=True, help="directory to write; must not exist")


def main(arguments: argparse.Namespace) -> None:
    """Record a demonstration with the task's scripted operator."""
    task = get_task(arguments.task)
    if arguments.root.exists():
        raise DemonstrationError(f"the root {arguments.root}, which exists", "a new path", "choose another --root")
    script = script_of(task)
    demonstration = record(task, script.make_operator(), script.start)
    demonstration.save(arguments.root)
    print(f"{arguments.root}: {len(demonstration)} ticks by {demonstration.metadata['operator']}")
