"""A disturbance -> the world the controller is tried in: the deployment model with loads, friction, delay and sensors.

500 Hz, all collisions, the same simulation that tasks run in.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from gym_demohlm.control.arm_load import HAND
from gym_demohlm.control.proprioception import Proprioception
from gym_demohlm.control.whole_body import WholeBodyController
from gym_demohlm.robot import g1
from gym_demohlm.simulation import Simulation
from gym_demohlm.task import ObjectSpec, Task
from gym_demohlm.timing import PHYSICS_DT


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What is not as the controller expects.

    Attributes:
        hand_loads: Masses in the left and right palm [kg].
        torso_load: Mass on the torso, 0.1 m behind and 0.2 m above its origin: a backpack [kg].
        friction: Of floor and soles; the model's by default.
        delay_ticks: Control ticks of 0.02 s by which the joint targets come late.
        timestep: Of the physics [s].
    """

    hand_loads: tuple[float, float] = (0.0, 0.0)
    torso_load: float = 0.0
    friction: float | None = None
    delay_ticks: int = 0
    timestep: float = PHYSICS_DT


class DelayedController(WholeBodyController):
    """A controller whose joint targets reach the motors some ticks late; for trials in which all worlds step together.

    Args:
        num_worlds: N.
        weights: As in ``WholeBodyController``.
        delay_ticks: Control ticks.
    """

    def __init__(self, num_worlds: int, weights: Path | None = None, delay_ticks: int = 1) -> None:
        super().__init__(num_worlds, weights)
        self._waiting = np.tile(g1.HOME, (delay_ticks, num_worlds, 1))

    def reset(self, worlds: np.ndarray, sensed: Proprioception) -> None:
        """Begin anew in some worlds; arguments as in the base class."""
        super().reset(worlds, sensed)
        self._waiting[:, worlds] = g1.HOME

    def step(self, sensed: Proprioception, commands: np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance by a tick and return the targets computed ``delay_ticks`` ago; arguments as in the base class."""
        chosen = slice(None) if worlds is None else worlds
        late = self._waiting[0, chosen].copy()
        self._waiting[:-1, chosen] = self._waiting[1:, chosen]
        self._waiting[-1, chosen] = super().step(sensed, commands, worlds)
        return late


def trial_task(disturbance: Disturbance | None = None) -> Task:
    """Return a task with nothing but the robot, disturbed, with sensors for torques, joint speeds and soles."""
    return Task(
        name="ControllerTrial",
        description="follow commands",
        hands="rubber",
        build=_builder(disturbance or Disturbance()),
        objects=(ObjectSpec(name="beacon", position=(5.0, 0.0, 1.0), placed=False),),
        success=lambda simulation: np.zeros(simulation.num_worlds, dtype=bool),
        gaze_target="beacon",
    )


def trial_simulation(
    num_worlds: int, disturbance: Disturbance | None = None, *, num_threads: int = 1, weights: Path | None = None
) -> Simulation:
    """Return worlds of ``trial_task``.

    Args:
        num_worlds: N.
        disturbance: None by default.
        num_threads: Threads of the physics.
        weights: Of the controller; the packaged ones by default.
    """
    ticks = disturbance.delay_ticks if disturbance else 0
    controller = DelayedController(num_worlds, weights, ticks) if ticks else WholeBodyController(num_worlds, weights)
    return Simulation(trial_task(disturbance), num_worlds, num_threads, controller)


def _builder(disturbance: Disturbance) -> Callable[[mujoco.MjSpec], None]:
    def build(spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_body(name="beacon", pos=[5.0, 0.0, 1.0], mocap=True)
        for side, mass in zip(g1.SIDES, disturbance.hand_loads, strict=True):
            if mass > 0:
                g1.add_load(spec, f"{side}_wrist_yaw_link", mass, HAND)
        if disturbance.torso_load > 0:
            g1.add_load(spec, "torso_link", disturbance.torso_load, (-0.1, 0.0, 0.2))
        if disturbance.friction is not None:
            for geom in spec.geoms:
                if geom.name == "floor" or "foot_point" in geom.name:
                    geom.friction = [disturbance.friction, 0.005, 0.0001]
        spec.option.timestep = disturbance.timestep
        _add_sensors(spec)

    return build


def _add_sensors(spec: mujoco.MjSpec) -> None:
    kind, of = mujoco.mjtSensor, mujoco.mjtObj
    for joint in g1.BODY_JOINTS:
        spec.add_sensor(name=f"{joint}_torque", type=kind.mjSENS_ACTUATORFRC, objtype=of.mjOBJ_ACTUATOR, objname=joint)
        name = f"{joint}_joint"
        spec.add_sensor(name=f"{joint}_speed", type=kind.mjSENS_JOINTVEL, objtype=of.mjOBJ_JOINT, objname=name)
    for side in g1.SIDES:
        sole = f"{side}_sole"
        site = spec.site(sole)
        site.type, site.size = mujoco.mjtGeom.mjGEOM_BOX, [0.1, 0.05, 0.02]
        spec.add_sensor(name=f"{sole}_speed", type=kind.mjSENS_FRAMELINVEL, objtype=of.mjOBJ_SITE, objname=sole)
        spec.add_sensor(name=f"{sole}_touch", type=kind.mjSENS_TOUCH, objtype=of.mjOBJ_SITE, objname=sole)
