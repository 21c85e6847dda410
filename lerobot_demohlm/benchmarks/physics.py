"""What each part of the robot's physics costs: ``python -m lerobot_demohlm.benchmarks.physics LiftBox GraspCube``.

The states of a task's demonstration are stepped on, each for a control tick, by a model with one part changed at a
time; all models take turns, so that a busy machine slows them alike. Prints one JSON line a task.
"""

import json
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from gym_demohlm.registry import get_task
from gym_demohlm.robot import g1
from gym_demohlm.robot.physics import FIRST, SECOND, Physics
from gym_demohlm.scene.scene import Scene
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import Task
from gym_demohlm.timing import CONTROL_DT
from lerobot_demohlm.demonstrations import demonstration as demonstrations


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A physics, and what else is changed in its models.

    Attributes:
        physics: Of the robot.
        impratio: MuJoCo's, where a hand touches an object; the scene's own by default.
        arm_friction: Whether the joints of the arms have dry friction too.
    """

    physics: Physics
    impratio: float | None = None
    arm_friction: bool = False


_RUBBING = replace(FIRST, dry_friction=True)
VARIANTS = {
    "self-collision": Variant(physics=replace(FIRST, self_collision=True)),
    "dry friction of legs and waist": Variant(physics=_RUBBING),
    "dry friction of all joints": Variant(physics=_RUBBING, arm_friction=True),
    "peak torque": Variant(physics=replace(FIRST, peak_torque=True)),
    "no islands": Variant(physics=replace(FIRST, islands=False)),
    "2 no-slip iterations": Variant(physics=replace(FIRST, noslip_iterations=2)),
    "1 no-slip iteration": Variant(physics=replace(FIRST, noslip_iterations=1)),
    "no no-slip pass": Variant(physics=replace(FIRST, noslip_iterations=0)),
    "impratio 100 instead": Variant(physics=replace(FIRST, noslip_iterations=0), impratio=100.0),
    "impratio 300 instead": Variant(physics=replace(FIRST, noslip_iterations=0), impratio=300.0),
    "second": Variant(physics=SECOND),
}
_EVERY = 3  # environment steps of the demonstration between two states
_ROUNDS = 12
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def measure(task: Task) -> dict[str, Any]:
    """Return what a physics step takes: ratios to the first physics, and microseconds of that, by moment.

    Returns:
        For "touching", moments in which a hand touches its object, and "free", the others: their number,
        ``first_us``, and a ratio for each variant, medians of rounds.
    """
    scenes = {name: _scene(task, variant) for name, variant in {"first": Variant(physics=FIRST), **VARIANTS}.items()}
    found: dict[str, Any] = {"task": task.name, "hands": task.hands}
    for kind, moments in zip(("touching", "free"), _moments(task), strict=True):
        models = {name: scene.physics if kind == "touching" else scene.untouched for name, scene in scenes.items()}
        data = {name: mujoco.MjData(model) for name, model in models.items()}
        steps = round(CONTROL_DT / models["first"].opt.timestep)
        rounds = []
        for _ in range(_ROUNDS):
            seconds = dict.fromkeys(models, 0.0)
            for state, control in moments:
                for name, model in models.items():
                    _set(model, data[name], state, control)
                    began = time.process_time()
                    mujoco.mj_step(model, data[name], steps)
                    seconds[name] += time.process_time() - began
            rounds.append(list(seconds.values()))
        table = np.array(rounds)  # (rounds, variants)
        ratios = np.median(table / table[:, :1], axis=0)
        first_us = round(1e6 * float(np.quantile(table[:, 0], 0.5)) / max(len(moments) * steps, 1), 1)
        of_each = {name: round(float(ratio), 3) for name, ratio in zip(models, ratios, strict=True) if name != "first"}
        found[kind] = {"moments": len(moments), "first_us": first_us, **of_each}
    return found


def _scene(task: Task, variant: Variant) -> Scene:
    scene = Scene(task, variant.physics)
    if variant.impratio is not None:
        scene.physics.opt.impratio = variant.impratio
    if variant.arm_friction:
        for model in (scene.physics, scene.untouched):
            for joint in g1.ARM_JOINTS:
                model.dof_frictionloss[model.joint(f"{joint}_joint").dofadr[0]] = g1.motor(joint).dry_friction
    return scene


_Moment = tuple[np.ndarray, np.ndarray]


def _moments(task: Task) -> tuple[list[_Moment], list[_Moment]]:
    """Return states of a demonstration and the controls that followed: hands touching an object, and not."""
    demonstration, simulation = demonstrations.load(None, task), Simulation(task)
    simulation.restore(dict(demonstration.start))
    touching: list[_Moment] = []
    free: list[_Moment] = []
    for index, action in enumerate(demonstration.action.astype(np.float64)):
        state = simulation.snapshot()["physics"][0]
        holds = any(np.any(simulation.contact_force(hand, name) > 0.0) for hand, name in task.contact_pairs)
        simulation.step(np.asarray(action)[None])
        if index % _EVERY == 0:
            (touching if holds else free).append((state, simulation.last_control[0]))
    simulation.close()
    return touching, free


def _set(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray, control: np.ndarray) -> None:
    """Bring a model to a state and a control: motors, then mocap positions and quaternions."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state, _STATE)
    motors, positions = model.nu, model.nu + 3 * model.nmocap
    data.ctrl[:] = control[:motors]
    data.mocap_pos[:] = control[motors:positions].reshape(-1, 3)
    data.mocap_quat[:] = control[positions:].reshape(-1, 4)


if __name__ == "__main__":
    for _name in sys.argv[1:] or ("LiftBox", "GraspCube", "PushCart"):
        print(json.dumps(measure(get_task(_name))), flush=True)
