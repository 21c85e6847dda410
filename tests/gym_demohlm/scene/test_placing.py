"""What an initial state does to objects that belong together, and what a world remembers beside its physics."""

import dataclasses

import mujoco
import numpy as np
import pytest

from gym_demohlm import poses
from gym_demohlm.control import command
from gym_demohlm.errors import SceneError, UnknownNameError
from gym_demohlm.scene import build_scene
from gym_demohlm.scene.furniture import add_cube, add_shape
from gym_demohlm.simulation import Simulation
from gym_demohlm.simulation.worlds import Worlds
from gym_demohlm.task import Memory, ObjectSpec, Task
from tests.helpers.hold import HoldController

CABINET, JAR, PEA = (0.6, 0.0, 0.5), (0.5, 0.2, 0.9), (0.5, 0.23, 0.93)


def _build(spec: mujoco.MjSpec) -> None:
    cabinet = spec.worldbody.add_body(name="cabinet", mocap=True, pos=CABINET)
    add_shape(cabinet, "cabinet", "box", [0.1, 0.1, 0.1])
    door = cabinet.add_body(name="door", pos=[-0.15, 0.1, 0.0])
    door.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    add_shape(door, "door", "box", [0.01, 0.1, 0.1], [0, -0.1, 0], mass=0.5)
    add_cube(spec, "jar", JAR, 0.05, 0.1)
    add_cube(spec, "pea", PEA, 0.01, 0.01)


TASK = Task(
    name="CabinetWithJar",
    description="Look at the jar on the cabinet.",
    hands="rubber",
    build=_build,
    objects=(
        ObjectSpec(name="cabinet", position=CABINET),
        ObjectSpec(name="door", position=(0.0, 0.0, 0.0), placed=False),
        ObjectSpec(name="jar", position=JAR, moves_with="cabinet"),
    ),
    success=lambda sim: sim.unstable,
    gaze_target="jar",
    riders={"jar": ("pea",)},
)


def test_things_that_belong_together_start_as_one_body() -> None:
    sim = Simulation(TASK, 2, controller=HoldController(2))
    sim.reset(
        [
            {"robot": [-0.5, 0.0, 0.0], "object": [0.0, 0.0, 0.0]},
            {"robot": [-0.5, 0.0, 0.0], "object": [0.08, -0.15, 0.7]},
        ]
    )
    motions = []
    for name in ("cabinet", "door", "jar", "pea"):
        here, moved = sim.pose(name)
        motions.append(moved @ poses.invert(here))
    np.testing.assert_allclose(motions, np.broadcast_to(motions[0], (4, 4, 4)), atol=1e-12)
    np.testing.assert_allclose(poses.yaw(motions[0]), 0.7)
    np.testing.assert_allclose(sim.pose("cabinet")[1, :3, 3], [0.6, 0.08, 0.35])


def test_what_cannot_be_placed_is_refused() -> None:
    placed_door = dataclasses.replace(TASK.objects[1], placed=True)
    with pytest.raises(SceneError, match="door"):
        build_scene(dataclasses.replace(TASK, objects=(TASK.objects[0], placed_door, TASK.objects[2])))
    with pytest.raises(SceneError, match="rider"):
        build_scene(dataclasses.replace(TASK, riders={"jar": ("door",)}))
    with pytest.raises(UnknownNameError, match="shelf"):
        dataclasses.replace(TASK, riders={"shelf": ("pea",)})
    with pytest.raises(UnknownNameError, match="shelf"):
        stray = dataclasses.replace(TASK.objects[2], moves_with="shelf")
        dataclasses.replace(TASK, objects=(TASK.objects[0], stray), gaze_target="cabinet", riders={})


def _count(sim: Worlds, memory: np.ndarray) -> np.ndarray:
    """Count steps in the first number, and keep the highest pelvis in the second."""
    height = sim.pose("pelvis")[:, 2, 3]
    return np.stack([memory[:, 0] + 1.0, np.maximum(memory[:, 1], height)], axis=1)


def test_a_memory_is_part_of_the_world() -> None:
    """It starts at zero, changes where a world is stepped, and comes back with a snapshot."""

    def draw(model: mujoco.MjModel, memory: np.ndarray) -> None:
        model.geom("jar").rgba[0] = memory[0] / 10

    task = dataclasses.replace(TASK, memory=Memory(size=2, update=_count, draw=draw))
    sim = Simulation(task, 2, controller=HoldController(2))
    commands = np.tile(command.rest(), (2, 1))
    for _ in range(3):
        sim.step(commands, np.array([True, False]))
    assert sim.memory[:, 0].tolist() == [3.0, 0.0]
    assert sim.memory[0, 1] > 0.6
    kept = sim.snapshot()
    sim.step(commands)
    assert sim.memory[:, 0].tolist() == [4.0, 1.0]
    sim.mj_data(0)
    assert sim.model.geom("jar").rgba[0] == pytest.approx(0.4)
    sim.restore(kept)
    assert sim.memory.tobytes() == kept["memory"].tobytes()
    sim.reset([task.default_state()], np.array([0]))
    assert sim.memory[0].tolist() == [0.0, 0.0]
    assert "memory" not in Simulation(TASK, 1, controller=HoldController(1)).snapshot()
